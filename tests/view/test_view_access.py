"""Access to the live page: tokens, origins and commands."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import UsageError
from edge.pipeline.commands import WAITING, Commands
from edge.view.access import grant, is_loopback
from edge.view.frames import execute

TOKEN = "correct-horse-battery"
OURS = "127.0.0.1:8077"


def asks(access, path="/", host=OURS, origin=None):
    """Status of the refusal, or None."""
    hosts = [host] if isinstance(host, str) else host
    refusal = access.refusal(path, hosts, [] if origin is None else [origin])
    return None if refusal is None else refusal[0].value


# Names of the machine at each address that it listens at, and names that a stranger decides what they point to.
NAMES = {
    "127.0.0.1": (
        "127.0.0.1:8077 127.0.0.1 127.1.2.3:9 localhost:9000 LOCALHOST:8077 [::1]:8077",
        "evil.example:8077 127.0.0.1.evil.example localhost.evil.example evil.example@127.0.0.1.x evil@127.0.0.1 "
        "evil:word@localhost:8077 192.168.0.5:8077 robot:8077 [::1 :8077",
    ),
    "192.168.0.5": ("192.168.0.5:8077 localhost:8077 robot:8077", "192.168.0.6:8077 robots.lan:8077"),
    "gripper.lan": ("Gripper.lan:8077", "evil.example:8077"),
    "0.0.0.0": ("192.168.0.5:8077 robot:8077 robot.local:8077 robot.lan:8077 ROBOT.local.:8077", "evil.example:8077"),
    "::": ("[fe80::1]:8077", "evil.example"),
}


@pytest.mark.parametrize("listens", NAMES)
def test_a_name_that_is_not_ours_is_refused(listens):
    """Other addresses than loopback need the token, too."""
    token = None if is_loopback(listens) else TOKEN
    access = grant(listens, "Robot", token)
    ours, strange = map(str.split, NAMES[listens])
    assert {host for host in ours + strange if asks(access, f"/ws?token={TOKEN}", host) is None} == set(ours)
    assert {asks(access, f"/ws?token={TOKEN}", host) for host in (*strange, "", [], [ours[0], strange[0]])} == {403}
    assert {asks(access, "/ws", host) for host in ours} == {None if token is None else 403}


@pytest.mark.parametrize("path", ["/ws", "/", "/ws?token=guessed"])
def test_without_a_token_only_our_page_opens_a_socket(path):
    """Also another program's page on this machine is a stranger's."""
    access = grant("127.0.0.1", "Robot.lan", None)
    strangers = f"http://evil.example http://127.0.0.1:8078 http://localhost:8077 https://{OURS} null file://127.0.0.1"
    assert asks(access, path, origin=f"http://{OURS}") is None
    assert {asks(access, path, origin=origin) for origin in (*strangers.split(), "")} == {403}
    assert asks(access, "/ws?origin=http://evil.example") == 403
    assert asks(access, f"/ws?origin=http://{OURS}") is None


def test_the_token_opens_and_no_other_does():
    access, host = grant("192.168.0.5", "robot", TOKEN), "192.168.0.5:8077"
    assert asks(access, f"/ws?token={TOKEN}", host) is None
    wrong = ("", "?token=", f"?token={TOKEN}x", f"?token={TOKEN[:-1]}", "?token=%ff", "?token=ü", f"?Token={TOKEN}")
    assert {asks(access, f"/ws{query}", host) for query in wrong} == {403}
    assert asks(access, "/", host) is None, "the page opens again without the token that it took out of the address"


def test_a_token_is_made_for_every_address_but_loopback():
    made = {grant(host, "robot", None).token for host in ("0.0.0.0", "::", "192.168.0.5", "gripper.lan")}
    assert None not in made and len(made) == 4 and all(len(token) >= 22 for token in made if token)
    assert {grant(host, "robot", None).token for host in ("127.0.0.1", "::1", "localhost")} == {None}
    assert grant("127.0.0.1", "robot", TOKEN).token == TOKEN
    assert not any(map(is_loopback, ("localhost.evil.example", "127.0.0.1.evil.example", "0.0.0.0", "")))


@pytest.mark.parametrize("token", ["", "short", "with a space in it", "semi;colon;semi;colon", "x" * 201])
def test_a_token_that_cannot_be_one_is_one_line(token):
    with pytest.raises(UsageError, match=rf"a token of {len(token)} characters .* expected at least 12"):
        grant("127.0.0.1", "robot", token)


@pytest.mark.parametrize(
    ("host", "token", "url"),
    [
        ("127.0.0.1", None, "http://127.0.0.1:8077/"),
        ("::1", None, "http://[::1]:8077/"),
        ("192.168.0.5", TOKEN, f"http://192.168.0.5:8077/?token={TOKEN}"),
        ("0.0.0.0", TOKEN, f"http://192.0.2.7:8077/?token={TOKEN}"),
        ("::", TOKEN, f"http://[2001:db8::7]:8077/?token={TOKEN}"),
    ],
)
def test_the_address_printed_is_one_that_is_granted(host, token, url):
    access = grant(host, "robot", token)
    shown = access.urls(8077, {"0.0.0.0": ["192.0.2.7"], "::": ["2001:db8::7"]}.get(host, []))
    assert shown == [url] + ([f"http://robot:8077/?token={TOKEN}"] if host in ("0.0.0.0", "::") else [])
    authority, _, rest = url.partition("//")[2].partition("/")
    assert asks(access, "/" + rest, authority) is None


@settings(max_examples=30)
@given(
    st.text() | st.sampled_from(["//[", "/ws?token=%", "/?" + "&" * 500, "/?token=\ud800"]),
    st.just(["10.0.0.1:1"]) | st.lists(st.text(), max_size=2),
    st.just([]) | st.lists(st.text(), max_size=2),
    st.text() | st.binary() | st.recursive(st.none() | st.booleans() | st.text(), st.lists).map(json.dumps),
)
def test_whatever_is_asked_is_answered(path, hosts, origins, message):
    grant("0.0.0.0", "robot", TOKEN).refusal(path, hosts, origins)
    execute(message, Commands())


@pytest.mark.parametrize(
    "message",
    [
        *("", "zero", "[]", "null", "[" * 4000, b'{"cmd": "zero"}', {"cmd": "stop"}, {"cmd": ["zero"]}),
        {"cmd": "zero", "sensro": "4"},
        {"cmd": "zero", "sensor": "\ud800"},  # which no record can hold
        {"cmd": "zero", "sensor": "\x1b]0;mine\a"},  # which a terminal would do
    ],
)
def test_what_is_no_command_is_counted_and_told(message):
    asked = Commands()
    why = execute(message if isinstance(message, (str, bytes)) else json.dumps(message), asked)
    assert asked.refused == 1 and asked.poll() == []
    assert why is not None and "expected {" in why and len(why) < 400 and "\n" not in why


def test_where_nobody_polls_a_few_wait_and_others_are_refused():
    asked = Commands()
    why = [execute('{"cmd": "reset"}', asked) for _ in range(WAITING + 3)]
    assert why.count(None) == WAITING and asked.refused == 3 and len(asked.poll()) == WAITING
    assert execute('{"cmd": "reset"}', asked) is None
