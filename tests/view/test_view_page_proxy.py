"""The page through a reverse proxy: below a path, under another name, and where the proxy or the server refuses it."""

import contextlib
import re
import socket
import threading

import pytest
from browser_samples import browser, playwright
from view_samples import live_page

__all__ = ["browser"]
TOKEN = "of-twelve-letters"


@pytest.fixture
def open_page(browser):
    """Function that opens pages, of which some may not get what they ask for."""
    with contextlib.ExitStack() as closing:

        def open_page(url):
            page = closing.enter_context(browser.new_context()).new_page()
            page.goto(url)
            return page

        yield open_page


def pump(source, sink):
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
    with contextlib.suppress(OSError):
        sink.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def proxy(port, *, below="/edge/", host=None, sockets=True, status="404 Not Found"):
    """Serve the page at `port` below a path, with another Host as nginx sends it; yield the address."""

    def serve(client):
        head = b""
        while b"\r\n\r\n" not in head:
            if not (data := client.recv(65536)):
                return
            head += data
        method, path, rest = head.split(b" ", 2)
        if not path.startswith(below.encode()) or (b"/ws" in path and sockets is None):
            client.sendall(f"HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode())
            client.close()
            return
        if host is not None:
            rest = re.sub(rb"\r\nHost: [^\r]*", b"\r\nHost: " + host.encode(), rest, flags=re.IGNORECASE)
        if not sockets:
            rest = re.sub(rb"\r\n(Upgrade|Connection): [^\r]*", b"", rest, flags=re.IGNORECASE)
        upstream = socket.create_connection(("127.0.0.1", port))
        upstream.sendall(b" ".join((method, path[len(below) - 1 :], rest)))
        threading.Thread(target=pump, args=(upstream, client), daemon=True).start()
        pump(client, upstream)

    def accept():
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}{below}"
        listener.shutdown(socket.SHUT_RDWR)


def connected(page):
    playwright.expect(page.locator("#link")).to_have_attribute("data-up", "yes")


@pytest.mark.parametrize("host", [None, "127.0.0.1:{port}", "localhost"])
@pytest.mark.parametrize("below", ["/edge/", "/", "/a/b/"])
def test_the_page_finds_its_socket_beside_itself(tmp_path, open_page, below, host):
    with live_page(tmp_path) as view, proxy(view.port, below=below, host=host and host.format(port=view.port)) as url:
        connected(open_page(url))


def test_a_proxy_with_a_token(tmp_path, open_page):
    with live_page(tmp_path, token=TOKEN) as view, proxy(view.port, host="edge_upstream") as url:
        page = open_page(f"{url}?token={TOKEN}")
        connected(page)
        page.reload()
        connected(page)


@pytest.mark.parametrize(
    ("settings", "token", "words"),
    [
        ({}, TOKEN, "the token is missing or wrong"),
        ({"sockets": False}, None, "a proxy must send HTTP/1.1 with the headers Upgrade and Connection"),
        ({"sockets": None}, None, "answers 404 for /edge/ws, and not edge-sr"),
        ({"sockets": None, "status": "502 Bad Gateway"}, None, "answers 502 for /edge/ws, and not edge-sr"),
    ],
)
def test_a_refused_page_shows_why(tmp_path, open_page, settings, token, words):
    with live_page(tmp_path, token=token) as view, proxy(view.port, **settings) as url:
        playwright.expect(open_page(url).locator("#trouble")).to_contain_text(words)


def test_a_page_of_another_name_shows_that_it_needs_the_token(tmp_path, open_page):
    """Chromium resolves every name that ends in .localhost to this machine, as a stranger's server may."""
    with live_page(tmp_path) as view, proxy(view.port, host=f"127.0.0.1:{view.port}") as url:
        page = open_page(url.replace("127.0.0.1", "robot.localhost"))
        playwright.expect(page.locator("#trouble")).to_contain_text("may not send requests to this server")
        playwright.expect(page.locator("#trouble")).to_contain_text("--view-token")
