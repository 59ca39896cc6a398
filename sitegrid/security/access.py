"""What the router lets each name do: Zenoh's access control, size and rate limits, made from the register.

Everything is denied that is not granted. Zenoh compares by inclusion: a granted `machine/a/**` never lets a
`machine/*/pose` pass. Exact keys are those of `protocol.wire.keys`; the patterns here are only ever used for granting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from protocol.wire import keys
from protocol.wire.codec import MAX_BATCH_BYTES, MAX_BUNDLE_BYTES, MAX_SMALL_BYTES
from sitegrid.security.register import Register, common_name

POSE_HZ, HEALTH_HZ = 50.0, 10.0  # of one link; poses come with 5 Hz, at ten times real time with 50
SPARE_BYTES = 4096  # for what goes along with a payload, as a signature

Keys = tuple[str, ...]


@dataclass(frozen=True)
class Grant:
    """Key expressions of what one name may do.

    puts, hears: publish and subscribe. asks, answers: query, and be a queryable. alive: show a liveliness token.
    watches: see the tokens of others.
    """

    puts: Keys = ()
    hears: Keys = ()
    asks: Keys = ()
    answers: Keys = ()
    alive: Keys = ()
    watches: Keys = ()


def grant(role: str, site: str, name: str) -> Grant:
    """What the holder of a role may do under its name."""
    return _GRANTS[role](site, name)


def router_settings(register: Register) -> dict[str, Any]:
    """The settings of the router's session, from the register."""
    return {
        "access_control": access_control(register),
        "low_pass_filter": size_limits(register.site),
        "downsampling": [_rate_limits(register.site)],
    }


def access_control(register: Register) -> dict[str, Any]:
    """Rules per certificate: nobody may do anything that is not granted to the name it proves."""
    rules, subjects, policies = [], [], []
    for name, entry in sorted(register.admitted().items()):
        own = _rules(name, register.site, grant(entry.role, register.site, name))
        rules += own
        subjects.append({"id": name, "cert_common_names": [common_name(name, entry.issue)]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def size_limits(site: str) -> list[dict[str, Any]]:
    """Largest payloads that the router takes in; larger ones vanish there (EVIDENCE: rx/max_message_size does nothing).

    Answers of the map server are not limited.
    """
    limits = (
        ("batches", ["query"], keys.ingest_all(site), MAX_BATCH_BYTES + SPARE_BYTES),
        ("questions", ["query"], keys.map_queries_all(site), MAX_BUNDLE_BYTES),
        ("commands", ["query"], keys.admin_all(site), MAX_SMALL_BYTES),
        ("readings", ["put"], _sensors_all(site), MAX_BUNDLE_BYTES),
        ("poses", ["put"], keys.poses_all(site), MAX_SMALL_BYTES),
        ("health", ["put"], keys.health_all(site), MAX_SMALL_BYTES),
    )
    return [
        {"id": name, "messages": messages, "flows": ["ingress"], "key_exprs": [key], "size_limit": size}
        for name, messages, key, size in limits
    ]


def _rate_limits(site: str) -> dict[str, Any]:
    """Only for what may get lost: never for what is acknowledged (EVIDENCE)."""
    rates = ((keys.poses_all(site), POSE_HZ), (keys.health_all(site), HEALTH_HZ))
    rules = [{"key_expr": key, "freq": rate} for key, rate in rates]
    return {"id": "rates", "messages": ["put"], "flows": ["ingress"], "rules": rules}


def _rules(name: str, site: str, granted: Grant) -> list[dict[str, Any]]:
    ways = (
        ("ingress", ("put",), granted.puts),
        ("ingress", ("declare_subscriber",), granted.hears),
        ("egress", ("put",), granted.hears),
        ("ingress", ("query",), granted.asks),
        ("egress", ("reply",), granted.asks),
        ("ingress", ("declare_queryable", "reply"), granted.answers),
        ("egress", ("query",), granted.answers),
        ("ingress", ("liveliness_token",), granted.alive),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), granted.watches),
        ("egress", ("liveliness_token", "reply"), granted.watches),
        # who listens and answers, without which nobody sends; it tells nothing but key expressions
        ("egress", ("declare_subscriber", "declare_queryable"), (_whole(site),)),
    )
    return [
        {
            "id": f"{name} {number}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": list(expressions),
        }
        for number, (flow, messages, expressions) in enumerate(ways)
        if expressions
    ]


# --- roles -----------------------------------------------------------------------------------------------------------


def _machine(site: str, name: str) -> Grant:
    return Grant(
        puts=(_whole(site, "machine", name),),
        hears=(keys.sensors(site, name), _whole(site, "map"), _whole(site, "base")),
        asks=(keys.ingest(site, name), keys.map_queries_all(site), keys.alive(site, name)),
        answers=(keys.alive(site, name),),  # who holds the name, if a second one comes
        alive=(keys.alive(site, name),),
        watches=(keys.alive(site, name),),
    )


def _visitor(site: str, _: str) -> Grant:
    return Grant(
        hears=(_whole(site, "map"), keys.poses_all(site), keys.health_all(site)),
        asks=(keys.map_queries_all(site),),
        watches=(keys.alive_all(site),),
    )


def _admin(site: str, name: str) -> Grant:
    visitor = _visitor(site, name)
    return replace(visitor, asks=(*visitor.asks, keys.admin_all(site)))


def _server(site: str, _: str) -> Grant:
    return Grant(
        puts=(_whole(site, "map"),),
        hears=(keys.poses_all(site), keys.health_all(site)),
        answers=(keys.ingest_all(site), keys.map_queries_all(site), keys.admin_all(site)),
        watches=(keys.alive_all(site),),
    )


def _sim(site: str, _: str) -> Grant:
    return Grant(puts=(_sensors_all(site),))


_GRANTS = {"machine": _machine, "visitor": _visitor, "admin": _admin, "server": _server, "sim": _sim}


def _whole(site: str, *parts: str) -> str:
    """Everything below a place in the keys of a site."""
    return "/".join((keys.ROOT, site, *parts, "**"))


def _sensors_all(site: str) -> str:
    return "/".join((keys.ROOT, site, "machine", "*", "sensors"))
