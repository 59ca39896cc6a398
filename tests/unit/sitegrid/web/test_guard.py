"""Whose request it is."""

from __future__ import annotations

import pytest

from sitegrid.web.guard import COOKIE, _token


@pytest.mark.parametrize(
    ("query", "headers", "token"),
    [
        ("", {}, ""),
        ("", {"authorization": "bearer  a "}, "a"),
        ("token=b", {"authorization": "Basic eHl6"}, "b"),  # of a proxy before it
        ("token=b", {"authorization": "Bearer "}, "b"),
        ("token=b", {"authorization": "Bearer a", "cookie": f"{COOKIE}=c"}, "a"),
        ("x=1", {"cookie": f"other=1; {COOKIE}=c"}, "c"),
        ("x=1", {"cookie": f"{COOKIE}=\x00"}, ""),
    ],
)
def test_a_token_is_read_from_header_address_or_cookie(query: str, headers: dict[str, str], token: str):
    assert _token({"query_string": query.encode()}, headers) == token
