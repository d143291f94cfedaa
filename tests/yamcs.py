"""A Yamcs server for tests, with the configuration that `ground yamcs` writes; skips where Java or Yamcs is missing."""

import contextlib
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ground.link.yamcs import write_yamcs

START_S = 120.0  # of a Java server on a busy machine
ANSWER_S = 60.0


def yamcs_jars() -> Path:
    """Return the folder of Yamcs' jars, as the wheel fprime-yamcs-bundle installs them; else skip the test."""
    if shutil.which("java") is None:
        pytest.skip("java is missing: apt-get install openjdk-17-jre-headless")
    spec = importlib.util.find_spec("fprime_yamcs_bundle")
    if spec is None or spec.origin is None:
        pytest.skip("Yamcs is missing: pip install fprime-yamcs-bundle")
    return Path(spec.origin).parent / "lib"


class Yamcs:
    """A running server: packets in by UDP, values out by HTTP."""

    def __init__(self, web_port: int, telemetry_port: int):
        self._url = f"http://127.0.0.1:{web_port}/api"
        self.telemetry_port = telemetry_port

    def ask(self, path: str, body: Any = None, method: str = "") -> Any:
        """Return the JSON lines of an answer, or the one value."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._url + path, data, {"Content-Type": "application/json"})
        request.method = method or ("GET" if data is None else "POST")
        try:
            with urllib.request.urlopen(request, timeout=ANSWER_S) as answer:
                return json.loads(answer.read() or b"{}")
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{path}: {error.read().decode()}") from error

    def stream(self, path: str, body: Any) -> Iterator[Any]:
        """Yield the JSON values of a streamed answer."""
        data = json.dumps(body).encode()
        request = urllib.request.Request(self._url + path, data, {"Content-Type": "application/json"})
        decoder = json.JSONDecoder()
        with urllib.request.urlopen(request, timeout=ANSWER_S) as answer:
            text = answer.read().decode()
        at = 0
        while at < len(text):
            value, at = decoder.raw_decode(text, at)
            yield value
            while at < len(text) and text[at].isspace():
                at += 1

    def download(self, path: str) -> bytes:
        with urllib.request.urlopen(self._url + path, timeout=ANSWER_S) as answer:
            return answer.read()

    def upload(self, path: str, content: bytes) -> None:
        request = urllib.request.Request(
            self._url + path, content, {"Content-Type": "application/octet-stream"}
        )
        urllib.request.urlopen(request, timeout=ANSWER_S).close()

    def packets_received(self) -> int:
        return int(self.ask("/links/obbgs/telemetry")["dataInCount"])

    def send(self, packets: list[bytes]) -> None:
        """Send packets, one a datagram, and wait until all have come; a few at a time, since UDP waits for nobody."""
        before = self.packets_received()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            for start in range(0, len(packets), 100):
                for packet in packets[start : start + 100]:
                    udp.sendto(packet, ("127.0.0.1", self.telemetry_port))
                wanted = before + min(start + 100, len(packets))
                wait_for(
                    lambda wanted=wanted: self.packets_received() >= wanted, "Yamcs receives the packets"
                )


def wait_for(condition: Callable[[], bool], what: str, timeout_s: float = ANSWER_S) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, f"waited {timeout_s:g} s in vain: {what}"
        time.sleep(0.05)


def free_ports() -> tuple[int, int]:
    """Return a UDP and a TCP port that nobody has now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp, socket.socket() as tcp:
        udp.bind(("127.0.0.1", 0))
        tcp.bind(("127.0.0.1", 0))
        return udp.getsockname()[1], tcp.getsockname()[1]


@contextlib.contextmanager
def running_yamcs(folder: Path, change: Callable[[Path], None] = lambda folder: None) -> Iterator[Yamcs]:
    """Run the configuration of `ground yamcs`, after `change` has worked on its folder, until the end of the block."""
    jars = yamcs_jars()
    port, web_port = free_ports()
    write_yamcs(folder, port, web_port)
    change(folder)
    # a short life is not worth the second compiler
    options = "-XX:TieredStopAtLevel=1 -XX:+UseSerialGC -Xmx400m"
    environment = os.environ | {"YAMCS_LIB": str(jars), "JAVA_TOOL_OPTIONS": options}
    with open(folder / "log", "wb") as log:
        process = subprocess.Popen(
            [folder / "start.sh"], env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            yamcs = Yamcs(web_port, port)

            def is_up() -> bool:
                assert process.poll() is None, (folder / "log").read_text()[-3000:]
                try:
                    return yamcs.ask("/links/obbgs/telemetry")["status"] == "OK"
                except (urllib.error.URLError, OSError):
                    return False

            wait_for(is_up, "Yamcs starts", START_S)
            yield yamcs
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
