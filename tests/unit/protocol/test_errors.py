import inspect

from protocol import errors
from protocol.errors import ConfigError, LinkError, MessageError, QueryError, Refusal, SitegridError


def test_every_error_has_one_base():
    classes = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, Exception)]
    assert all(issubclass(c, SitegridError) for c in classes)


def test_messages_name_the_place():
    assert str(MessageError(Refusal.NOT_FINITE, "nan", field="x_m", row=3)) == "x_m[3]: nan"
    assert str(MessageError(Refusal.VERSION, "2", field="v")) == "v: 2"
    assert str(MessageError(Refusal.TOO_LARGE, "5 bytes")) == "5 bytes"
    assert str(ConfigError("a.toml", "bad")) == "a.toml: bad"
    assert str(LinkError("tcp/1", "no")) == "tcp/1: no"


def test_reasons_are_plain_words():
    assert QueryError(Refusal.UNKNOWN_LAYER, "x").reason == "unknown_layer"
    assert type(QueryError("from afar", "x").reason) is str
    assert all(reason.value == reason.name.lower() for reason in Refusal)
