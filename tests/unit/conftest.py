"""What several files of these tests use."""

from collections.abc import Iterator

import pytest

from pliant.bus.session import free_endpoint, open_router


@pytest.fixture
def endpoint() -> Iterator[str]:
    found = free_endpoint()
    router = open_router(found)
    yield found
    router.close()
