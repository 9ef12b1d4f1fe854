"""Access to the live page: tokens, origins and commands."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import UsageError
from edge.pipeline.commands import WAITING, Command, Commands
from edge.view.access import grant, is_loopback
from edge.view.viewer_commands import LONGEST_BYTES, execute
from edge.view.viewer_state import Viewer
from firmware_bridge.links.replay_player import Player

TOKEN = "correct-horse-battery"


def asks(access, path="/", host="127.0.0.1:8077", origin=None):
    """Status of the refusal, or None."""
    hosts = [host] if isinstance(host, str) else host
    refusal = access.refusal(path, hosts, [] if origin is None else [origin])
    return None if refusal is None else refusal.status.value


class TestAccess:
    @pytest.mark.parametrize("path", ["/", "/ws", "/?x=1", "/ws?token="])
    def test_on_loopback_page_and_socket_are_there_for_this_machine(self, path):
        assert asks(grant("127.0.0.1", "robot", None), path) is None

    @pytest.mark.parametrize("path", ["/favicon.ico", "/ws/", "//", "/page.html", "/../etc/passwd", "", "*"])
    def test_there_is_nothing_else(self, path):
        assert asks(grant("127.0.0.1", "robot", None), path) == 404

    @pytest.mark.parametrize(
        ("host", "ours"),
        [
            ("127.0.0.1:8077", True),
            ("127.0.0.1", True),
            ("127.1.2.3:9", True),
            ("localhost:9000", True),  # by ssh -L 9000:localhost:8077
            ("LOCALHOST:8077", True),
            ("[::1]:8077", True),
            ("evil.example:8077", False),
            ("127.0.0.1.evil.example", False),
            ("localhost.evil.example", False),
            ("evil.example@127.0.0.1.x", False),
            ("evil@127.0.0.1", False),
            ("evil:word@localhost:8077", False),
            ("192.168.0.5:8077", False),
            ("robot:8077", False),
            ("", False),
            ("[::1", False),
            (":8077", False),
            ([], False),
            (["127.0.0.1:8077", "evil.example"], False),
        ],
    )
    def test_a_name_that_is_not_ours_is_refused(self, host, ours):
        """A stranger decides what the stranger's name points to."""
        assert asks(grant("127.0.0.1", "robot", None), host=host) == (None if ours else 403)

    @pytest.mark.parametrize(
        ("listens", "host", "ours"),
        [
            ("192.168.0.5", "192.168.0.5:8077", True),
            ("192.168.0.5", "localhost:8077", True),
            ("192.168.0.5", "192.168.0.6:8077", False),
            ("gripper.lan", "Gripper.lan:8077", True),
            ("gripper.lan", "evil.example:8077", False),
            ("0.0.0.0", "192.168.0.5:8077", True),
            ("0.0.0.0", "robot:8077", True),
            ("0.0.0.0", "robot.local:8077", True),
            ("0.0.0.0", "robot.lan:8077", True),
            ("0.0.0.0", "ROBOT.local.:8077", True),
            ("192.168.0.5", "robot:8077", True),
            ("192.168.0.5", "robots.lan:8077", False),
            ("0.0.0.0", "evil.example:8077", False),
            ("::", "[fe80::1]:8077", True),
        ],
    )
    def test_other_addresses_are_called_by_their_name_and_need_the_token(self, listens, host, ours):
        access = grant(listens, "Robot", TOKEN)
        assert asks(access, f"/ws?token={TOKEN}", host) == (None if ours else 403)
        assert asks(access, "/ws", host) == 403

    def test_who_is_refused_for_a_name_is_told_what_to_do(self):
        refusal = grant("0.0.0.0", "robot", TOKEN).refusal("/", ["arm.lan:8077"], [])
        assert refusal is not None and "arm.lan:8077; open the address that edge-sr printed" in refusal.text

    @pytest.mark.parametrize(
        ("origin", "refused"),
        [
            ("http://127.0.0.1:8077", None),
            ("http://127.0.0.1:8078", 403),  # another program's page on this machine
            ("http://localhost:8077", 403),
            ("https://127.0.0.1:8077", 403),
            ("http://evil.example", 403),
            ("null", 403),
            ("", 403),
        ],
    )
    def test_only_our_own_page_may_open_a_socket(self, origin, refused):
        assert asks(grant("127.0.0.1", "robot", None), "/ws", origin=origin) == refused

    @pytest.mark.parametrize(
        ("origin", "path", "refused"),
        [
            # A proxy asks as 127.0.0.1:8077, whatever its own name; what it serves has the key.
            ("http://127.0.0.1:80", "/ws?key={key}", None),
            ("https://192.168.0.5", "/ws?key={key}", None),
            ("https://[fe80::1]:8443", "/ws?key={key}", None),
            ("http://localhost", "/ws?key={key}", None),
            ("http://robot", "/ws?key={key}", None),
            ("http://Robot.local:8080", "/ws?key={key}", None),
            ("http://127.0.0.1:80", "/ws", 403),
            ("http://127.0.0.1:80", "/ws?key=", 403),
            ("http://127.0.0.1:80", "/ws?key={key}x", 403),
            ("http://127.0.0.1:80", "/?key={key}", 403),
            # A stranger's name may point to the proxy, and the stranger's page then read the key.
            ("http://evil.example", "/ws?key={key}", 403),
            ("http://robot.evil.example", "/ws?key={key}", 403),
            ("http://127.0.0.1.evil.example", "/ws?key={key}", 403),
            ("http://evil@127.0.0.1", "/ws?key={key}", 403),
            ("null", "/ws?key={key}", 403),
            ("file://127.0.0.1", "/ws?key={key}", 403),
            (None, "/ws?key={key}&origin=http://evil.example", 403),
            (None, "/ws?key={key}&origin=http://127.0.0.1:8077", None),
        ],
    )
    def test_a_page_through_a_proxy_has_the_key_and_no_strangers_name(self, origin, path, refused):
        access = grant("127.0.0.1", "Robot.lan", None)
        assert asks(access, path.format(key=access.key), origin=origin) == refused

    def test_with_the_token_a_page_may_have_any_name(self):
        access = grant("127.0.0.1", "robot", TOKEN)
        assert asks(access, f"/ws?token={TOKEN}", origin="https://robot.example") is None
        assert asks(access, f"/ws?token={TOKEN}", "edge_upstream", "https://robot.example") is None
        assert asks(access, "/ws?token=", origin="https://robot.example") == 403
        assert asks(access, f"/ws?token={TOKEN}", "evil.example", "http://evil.example") == 403
        assert asks(grant("127.0.0.1", "robot", None), "/ws", "edge_upstream") == 403

    def test_every_run_has_a_key_of_its_own(self):
        assert len({grant("127.0.0.1", "robot", None).key for _ in range(4)}) == 4

    def test_the_page_opens_again_without_the_token_that_it_took_out_of_the_address(self):
        assert asks(grant("192.168.0.5", "robot", TOKEN), "/", "192.168.0.5:8077") is None

    def test_the_token_opens_and_no_other_does(self):
        access, path = grant("192.168.0.5", "robot", TOKEN), "/ws"
        host = "192.168.0.5:8077"
        assert asks(access, f"{path}?token={TOKEN}", host) is None
        for query in (
            "",
            "?token=",
            f"?token={TOKEN}x",
            f"?token={TOKEN[:-1]}",
            "?token=%ff",
            "?token=ü",
            "?Token=" + TOKEN,
        ):
            assert asks(access, path + query, host) == 403

    def test_a_token_is_made_for_every_address_but_loopback(self):
        made = {grant(host, "robot", None).token for host in ("0.0.0.0", "::", "192.168.0.5", "gripper.lan")}
        assert None not in made and len(made) == 4 and all(len(token) >= 22 for token in made if token)
        assert {grant(host, "robot", None).token for host in ("127.0.0.1", "::1", "localhost")} == {None}
        assert grant("127.0.0.1", "robot", TOKEN).token == TOKEN

    def test_names_that_look_like_loopback_are_not(self):
        assert not any(map(is_loopback, ("localhost.evil.example", "127.0.0.1.evil.example", "0.0.0.0", "")))

    @pytest.mark.parametrize("token", ["", "short", "with a space in it", "semi;colon;semi;colon", "x" * 201])
    def test_a_token_that_cannot_be_one_is_one_line(self, token):
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
    def test_the_address_printed_is_one_that_is_granted(self, host, token, url):
        access = grant(host, "robot", token)
        shown = access.urls(8077, {"0.0.0.0": ["192.0.2.7"], "::": ["2001:db8::7"]}.get(host, []))
        assert shown[0] == url
        assert shown[1:] == ([f"http://robot:8077/?token={TOKEN}"] if host in ("0.0.0.0", "::") else [])
        authority, _, rest = url.partition("//")[2].partition("/")
        assert asks(access, "/" + rest, authority) is None

    @settings(max_examples=60)
    @given(
        st.text() | st.sampled_from(["//[", "/ws?token=%", "/?" + "&" * 500, "/?token=\ud800"]),
        st.just(["10.0.0.1:1"]) | st.lists(st.text(), max_size=2),
        st.just([]) | st.lists(st.text(), max_size=2),
    )
    def test_whatever_is_asked_is_answered(self, path, hosts, origins):
        grant("0.0.0.0", "robot", TOKEN).refusal(path, hosts, origins)


class TestAsked:
    def execute(self, *messages):
        asked = Commands()
        why = [execute(m if isinstance(m, (str, bytes)) else json.dumps(m), Viewer(), asked) for m in messages]
        return asked, why

    def test_a_recording_is_steered_by_what_makes_sense(self):
        player, asked = Player(), Commands()
        player.reach(0.0, 6.0, 0)

        def play(**wanted):
            return execute(json.dumps({"cmd": "play"} | wanted), Viewer(), asked, player)

        assert play(on=False, speed=0.5, at_s=4) is None
        assert (player.state.paused, player.state.speed, player.take_jump()) == (True, 0.5, 4.0)
        assert play(at_s=99) is None and player.take_jump() == 6.0
        before = player.state
        for wrong in (
            {"at_s": "4"},
            {"at_s": 10**400},
            {"speed": 10**400},
            {"at_s": True},
            {"speed": 0},
            {"speed": -1},
            {"on": 1},
            {"att_s": 4},
        ):
            assert "expected" in str(play(**wrong)), wrong
        assert execute('{"cmd": "play", "at_s": NaN}', Viewer(), asked, player) is not None
        assert player.state == before and player.take_jump() is None
        assert execute('{"cmd": "play", "on": true}', Viewer(), asked) == "no recording is played that a page can steer"
        assert asked.poll() == []

    def test_commands_are_polled_once_in_their_order(self):
        asked, why = self.execute(
            {"cmd": "zero"},
            {"cmd": "zero", "sensor": "4", "force": True},
            {"cmd": "reset"},
            {"cmd": "record", "on": True},
            {"cmd": "record", "on": False},
        )
        recorded = []
        asked.record = recorded.append
        assert why == [None] * 5 and asked.refused == 0
        assert asked.poll() == [Command("zero"), Command("zero", "4", True), Command("reset")]
        assert recorded == [True, False] and asked.poll() == []

    @pytest.mark.parametrize(
        "message",
        [
            "",
            "zero",
            "[]",
            "null",
            "[" * 4000,
            b'{"cmd": "zero"}',
            {"cmd": "stop"},
            {"cmd": "zero", "sensro": "4"},
            {"cmd": "zero", "sensor": 4},
            {"cmd": "zero", "sensor": "\ud800"},  # which no record can hold
            {"cmd": "zero", "sensor": "\x1b]0;mine\a"},  # which a terminal would do
            {"cmd": "zero", "force": 1},
            {"cmd": "record"},
            {"cmd": "record", "on": "yes"},
            {"cmd": "record", "on": True, "path": "/etc/passwd"},
            {"cmd": "pause"},
            {"cmd": ["zero"]},
            {"cmd": {}},
        ],
    )
    def test_what_is_none_is_counted_and_told(self, message):
        asked, [why] = self.execute(message)
        assert asked.refused == 1 and asked.poll() == []
        assert why is not None and "expected {" in why and len(why) < 400 and "\n" not in why

    @settings(max_examples=40)
    @given(st.text() | st.binary() | st.recursive(st.none() | st.booleans() | st.text(), st.lists).map(json.dumps))
    def test_nothing_raises(self, message):
        execute(message, Viewer(), Commands())

    def test_pausing_is_the_viewers_own(self):
        asked, viewer, other = Commands(), Viewer(), Viewer()
        assert execute('{"cmd": "pause", "on": true}', viewer, asked) is None
        assert viewer.paused and not other.paused and asked.poll() == []
        execute('{"cmd": "pause", "on": false}', viewer, asked)
        assert not viewer.paused

    def test_where_nobody_polls_a_few_wait_and_the_others_are_refused(self):
        asked, why = self.execute(*[{"cmd": "reset"}] * (WAITING + 3))
        assert why.count(None) == WAITING and asked.refused == 3 and len(asked.poll()) == WAITING
        assert execute('{"cmd": "reset"}', Viewer(), asked) is None

    def test_the_longest_message_holds_any_command(self):
        assert len(json.dumps({"cmd": "zero", "sensor": "s" * 1000, "force": False})) < LONGEST_BYTES
