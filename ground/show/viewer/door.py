"""The viewer's port: a server that binds exactly what was asked for and answers only the page that it served itself.

What that page could not have said ends its connection before viser acts on it.
"""

import contextlib
import errno
import functools
import gzip
import http
import io
import ipaddress
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from ground.show.viewer.messages import wrong
from obbgs_base.errors import ObbgsError, reason

log = logging.getLogger(__name__)
POLICY_VIOLATION = 1008  # RFC 6455, section 7.4.1
LABEL = "obbgs"  # of the panel
# viser has no setting for it: its panel covers most of a narrow screen until its title is touched. A touch that comes
# first decides: folded after it, a panel that was just opened would close.
FOLD_ON_A_PHONE = b"""<script>
if (innerWidth < 600) {
  let isTouched = false;
  addEventListener("pointerdown", () => { isTouched = true; }, { capture: true, once: true });
  const look = setInterval(() => {
    const isTitle = (e) => e.children.length === 0 && e.textContent.trim() === "obbgs";
    const title = [...document.querySelectorAll("body *")].find(isTitle);
    if (title || isTouched) clearInterval(look);
    if (title && !isTouched) title.click();
  }, 300);
}
</script>"""
LONGEST_REASON = 120  # bytes; section 5.5 allows 123


class ViewError(ObbgsError):
    """The viewer cannot be shown; the message says why."""


def opened(host: str, port: int) -> viser.ViserServer:
    """Return a running server without a scene.

    Raises:
        ViewError: host or port cannot be bound; viser itself would silently take another port.
    """
    _check_free(host, port)
    with _guarded(host), contextlib.redirect_stdout(io.StringIO()):  # it prints its address, and we ours
        server = viser.ViserServer(host=host, port=port, label=LABEL, verbose=False)
    if port and server.get_port() != port:
        server.stop()
        raise ViewError(_taken(host, port, "it was taken meanwhile"))
    return server


def is_loopback(host: str) -> bool:
    """Return whether a host name or address means this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refused(request: Request, host: str) -> str | None:
    """Return why a connection is refused, None if it is not.

    A page of another site, open in the same browser, may connect to any port of this machine: its Origin tells. A site
    whose name was made to point here (DNS rebinding) has an Origin that fits, but not one of this machine's names.
    """
    asked, origin = request.headers.get("Host", ""), urlsplit(request.headers.get("Origin", ""))
    if is_loopback(host) and not is_loopback(urlsplit(f"//{asked}").hostname or ""):
        return "this server is for this machine only"
    if request.headers.get("Upgrade", "").lower() == "websocket" and origin.netloc != asked:
        return "only the page that this server sent may connect"
    return None


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Let a server that is made in the block ask `refused` and `wrong` first; viser has no setting for that."""
    serve = websockets.asyncio.server.serve

    def guarded_serve(handler: Callable[[Any], Awaitable[None]], *args, process_request, **options):
        async def checking(connection: ServerConnection) -> None:
            await handler(_Checked(connection))

        def first(connection, request: Request) -> Response | None:
            if (reason := refused(request, host)) is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return _folding(process_request(connection, request))

        return serve(checking, *args, process_request=first, **options)

    websockets.asyncio.server.serve = functools.wraps(serve)(guarded_serve)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]


def _folding(response: Response | None) -> Response | None:
    """Return viser's page with a program that folds its panel on a phone; anything else as it is."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    page = gzip.decompress(response.body) if zipped else response.body
    body = page.replace(b"</body>", FOLD_ON_A_PHONE + b"</body>", 1)
    response.body = gzip.compress(body) if zipped else body
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


class _Checked:
    """A connection that is closed at the first message which is `wrong`."""

    def __init__(self, connection: ServerConnection):
        self._connection = connection

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> str | bytes:
        data = await self._connection.recv()
        if (reason := wrong(data)) is not None:
            log.warning("a connection to the page is closed: %s", reason)
            await self._connection.close(
                POLICY_VIOLATION, reason.encode()[:LONGEST_REASON].decode(errors="ignore")
            )
            return await self._connection.recv()  # raises that it is closed
        return data


def _check_free(host: str, port: int) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            what = f"cannot listen on {host}: {reason(error)}"
            raise ViewError(
                f"{what}; give an address of this machine with --host, 0.0.0.0 for all"
            ) from error
        raise ViewError(_taken(host, port, reason(error))) from error


def _taken(host: str, port: int, why: str) -> str:
    return f"cannot listen on {host} port {port}: {why}; give another with --port, 0 for any that is free"
