"""The router's access control: Zenoh rules, size and rate limits from the register.

What is not granted is denied. Zenoh compares by inclusion: a grant of `machine/a/**` does not allow `machine/*/pose`.
Exact keys: `protocol.wire.keys`; patterns here only serve grants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from protocol.wire import keys
from protocol.wire.codec import MAX_BATCH_BYTES, MAX_BUNDLE_BYTES, MAX_CORRECTIONS_BYTES
from protocol.wire.fields import MAX_SMALL_BYTES
from sitegrid.security.register import Register, common_name

POSE_HZ, HEALTH_HZ = 50.0, 10.0  # per link; poses come at 5 Hz, at 50 in ten times real time
SPARE_BYTES = 4096  # for attachments, like signatures

Keys = tuple[str, ...]


@dataclass(frozen=True)
class Grant:
    """Keys that one name may publish, subscribe to, query and answer.

    alive: own liveliness token. watch: tokens of others.
    """

    publish: Keys = ()
    subscribe: Keys = ()
    query: Keys = ()
    answer: Keys = ()
    alive: Keys = ()
    watch: Keys = ()


def grant(role: str, site: str, name: str) -> Grant:
    """Rights of a role under its name."""
    map_all, poses, health = _whole(site, "map"), keys.poses_all(site), keys.health_all(site)
    asks, alive = (keys.map_queries_all(site), keys.follower_queries_all(site)), (keys.alive(site, name),)
    followers = keys.followers_alive_all(site)
    visitor = Grant(
        subscribe=(map_all, poses, health),
        query=asks,
        watch=(keys.alive_all(site), followers),
    )
    grants = {
        "machine": Grant(
            publish=(_whole(site, "machine", name),),
            subscribe=(keys.sensors(site, name), map_all, keys.corrections_all(site)),
            query=(keys.ingest(site, name), *asks, *alive),
            answer=alive,  # the name's holder, for a second claimant
            alive=alive,
            watch=(*alive, followers),
        ),
        "corrections": Grant(publish=(keys.corrections(site, name),)),
        "visitor": visitor,
        "admin": replace(visitor, query=(*asks, keys.admin_all(site))),
        "server": Grant(
            publish=(map_all,),
            subscribe=(poses, health),
            query=(keys.writer(site),),
            answer=(
                keys.ingest_all(site),
                keys.map_queries_all(site),
                keys.admin_all(site),
                keys.writer(site),
            ),
            watch=(keys.alive_all(site),),
        ),
        "follower": Grant(
            query=(keys.follower_owner(site, name),),
            answer=(keys.follower_queries(site, name), keys.follower_owner(site, name)),
            alive=(keys.follower_alive(site, name),),
        ),
        "sim": Grant(publish=(_sensors_all(site),), subscribe=(health,)),
    }
    return grants[role]


def router_settings(register: Register) -> dict[str, Any]:
    """Router session settings from the register."""
    limits = {"low_pass_filter": size_limits(register.site), "downsampling": [_rate_limits(register.site)]}
    return {"access_control": access_control(register), **limits}


def access_control(register: Register) -> dict[str, Any]:
    """Rules per certificate: only grants to its name."""
    rules, subjects, policies = [], [], []
    for name, entry in sorted(register.admitted().items()):
        own = _rules(name, register.site, grant(entry.role, register.site, name))
        rules += own
        subjects.append({"id": name, "cert_common_names": [common_name(name, entry.issue)]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    access = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **access}


def size_limits(site: str) -> list[dict[str, Any]]:
    """Payload limits; the router drops larger ones silently.

    Zenoh's setting `rx/max_message_size` has no effect. Map server answers are unlimited.
    """
    limits = (
        ("batches", ["query"], keys.ingest_all(site), MAX_BATCH_BYTES + SPARE_BYTES),
        ("questions", ["query"], keys.map_queries_all(site), MAX_BUNDLE_BYTES),
        ("questions to followers", ["query"], keys.follower_queries_all(site), MAX_SMALL_BYTES),
        ("claims", ["query"], keys.writer(site), MAX_SMALL_BYTES),
        ("commands", ["query"], keys.admin_all(site), MAX_SMALL_BYTES),
        ("readings", ["put"], _sensors_all(site), MAX_BUNDLE_BYTES),
        ("corrections", ["put"], keys.corrections_all(site), MAX_CORRECTIONS_BYTES),
        ("poses", ["put"], keys.poses_all(site), MAX_SMALL_BYTES),
        ("health", ["put"], keys.health_all(site), MAX_SMALL_BYTES),
    )
    return [
        {"id": name, "messages": messages, "flows": ["ingress"], "key_exprs": [key], "size_limit": size}
        for name, messages, key, size in limits
    ]


def _rate_limits(site: str) -> dict[str, Any]:
    """Rate limits for unacknowledged messages only; on others they would lose samples."""
    rates = (
        (keys.poses_all(site), POSE_HZ),
        (keys.corrections_all(site), POSE_HZ),
        (keys.health_all(site), HEALTH_HZ),
    )
    rules = [{"key_expr": key, "freq": rate} for key, rate in rates]
    return {"id": "rates", "messages": ["put"], "flows": ["ingress"], "rules": rules}


def _rules(name: str, site: str, granted: Grant) -> list[dict[str, Any]]:
    flows = (
        ("ingress", ("put",), granted.publish),
        ("ingress", ("declare_subscriber",), granted.subscribe),
        ("egress", ("put",), granted.subscribe),
        ("ingress", ("query",), granted.query),
        ("egress", ("reply",), granted.query),
        ("ingress", ("declare_queryable", "reply"), granted.answer),
        ("egress", ("query",), granted.answer),
        ("ingress", ("liveliness_token",), granted.alive),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), granted.watch),
        ("egress", ("liveliness_token", "reply"), granted.watch),
        # these declarations make peers send; they contain key expressions only
        ("egress", ("declare_subscriber", "declare_queryable"), (_whole(site),)),
    )
    return [
        {
            "id": f"{name} {number}",
            "permission": "allow",
            "flows": [flow],
            "messages": [*messages],
            "key_exprs": [*keys_],
        }
        for number, (flow, messages, keys_) in enumerate(flows)
        if keys_
    ]


def _whole(site: str, *parts: str) -> str:
    """All keys below a place."""
    return "/".join((keys.ROOT, site, *parts, "**"))


def _sensors_all(site: str) -> str:
    return "/".join((keys.ROOT, site, "machine", "*", "sensors"))
