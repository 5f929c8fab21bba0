"""Zenoh's access control: which topics a certificate may publish, by the list of processes."""

from collections.abc import Sequence
from typing import Any

from pliant.bus.health import health_key
from pliant.bus.peers import OVER_KEY, STOP_KEY
from pliant_services.processes import BY_NAME, PROCESSES, outputs_of
from pliant_services.security.certificates import ANY_SESSION, ROUTER, common_name

OPERATOR = "operator"
"""May look at every session and end it; also the name of viewers' certificates."""
NAMES = (ROUTER, OPERATOR, *(process.name for process in PROCESSES))
"""Everybody who needs a certificate."""

_READ = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"]
_WRITE = ["put", "delete", "liveliness_token", "declare_queryable", "reply"]


def access_control(sessions: Sequence[str] = ()) -> dict[str, Any]:
    """Everybody with a certificate may read; a service publishes its own topics and no other.

    sessions: each has certificates of its own, which are good for nothing else; without any, the
    certificates that name no session are good for all.
    """
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    for session in sessions or (ANY_SESSION,):
        read, deliver = f"read {session}", f"deliver {session}"
        all_keys = ["pliant/**" if session == ANY_SESSION else f"pliant/{session}/**"]
        rules.append(_rule(read, _READ, ["ingress"], all_keys))
        rules.append(_rule(deliver, [*_READ, *_WRITE], ["egress"], all_keys))
        for name in NAMES[1:]:
            holder = common_name(name, session)
            keys = list(may_write(name, session))
            rules.append(_rule(f"write {holder}", _WRITE, ["ingress"], keys))
            policies.append({"rules": [read, deliver, f"write {holder}"], "subjects": [holder]})
            subjects.append({"id": holder, "cert_common_names": [holder]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def may_write(name: str, session: str = ANY_SESSION) -> tuple[str, ...]:
    """The keys that a holder of this certificate may publish."""
    if name == OPERATOR:
        return (f"pliant/{session}/{STOP_KEY}", f"pliant/{session}/viewer/*")
    own = [topic.key for topic in outputs_of(name)]
    keys = [*own, health_key(name), f"credit/**/{name}", f"ready/{name}/**"]
    keys += [OVER_KEY] if BY_NAME[name].observer else []
    return tuple(f"pliant/{session}/{key}" for key in keys)


def _rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "messages": messages,
        "flows": flows,
        "key_exprs": keys,
    }
