"""Who may publish what, by the name in the certificate: Zenoh's access control from the one list of
processes."""

from typing import Any

from pliant.bus.health import health_key
from pliant.bus.peers import OVER_KEY, STOP_KEY
from pliant_services.processes import BY_NAME, PROCESSES, outputs_of
from pliant_services.security.certificates import ROUTER

OPERATOR = "operator"
"""May look at every session and end it; also the name of viewers' certificates."""
NAMES = (ROUTER, OPERATOR, *(process.name for process in PROCESSES))
"""Everybody who needs a certificate."""

_READ = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"]
_WRITE = ["put", "delete", "liveliness_token", "declare_queryable", "reply"]


def access_control() -> dict[str, Any]:
    """Everybody with a certificate may read; a service publishes its own topics and no other."""
    rules: list[dict[str, Any]] = [
        _rule("read", _READ, ["ingress"], ["pliant/**"]),
        _rule("deliver", [*_READ, *_WRITE], ["egress"], ["pliant/**"]),
    ]
    policies: list[dict[str, Any]] = []
    for name in NAMES[1:]:
        rules.append(_rule(f"write {name}", _WRITE, ["ingress"], list(may_write(name))))
        policies.append({"rules": ["read", "deliver", f"write {name}"], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in NAMES[1:]],
        "policies": policies,
    }


def may_write(name: str) -> tuple[str, ...]:
    """The keys that a holder of this certificate may publish."""
    if name == OPERATOR:
        return (f"pliant/*/{STOP_KEY}", "pliant/*/viewer/*")
    own = [topic.key for topic in outputs_of(name)]
    keys = [*own, health_key(name), f"credit/**/{name}", f"ready/{name}/**"]
    keys += [OVER_KEY] if BY_NAME[name].observer else []
    return tuple(f"pliant/*/{key}" for key in keys)


def _rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "messages": messages,
        "flows": flows,
        "key_exprs": keys,
    }
