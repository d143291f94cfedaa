"""Files exchanged with Yamcs' own CFDP service, which knows the modular checksum only, at 10 % loss both ways."""

import contextlib
import random
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from flightsw.icd.frame import encode_frame
from flightsw.icd.transfer import UPLINK, Receiver, Sender
from tests.yamcs import Yamcs, free_ports, running_yamcs

LOSS = 0.1
INTERVAL_S = 0.5
MAX_PDU_BYTES = 300
TIMEOUT_S = 60.0
SERVICE = {
    "class": "org.yamcs.cfdp.CfdpService",
    "name": "cfdp",
    "args": {
        "entityIdLength": 1,
        "maxPduSize": MAX_PDU_BYTES,
        "sleepBetweenPdus": 2,  # ms
        "eofAckTimeout": 500,
        "eofAckLimit": 10,
        "finAckTimeout": 500,
        "finAckLimit": 10,
        "nakTimeout": 500,
        "immediateNak": False,
        "allowConcurrentFileOverwrites": True,
        "localEntities": [{"name": "ground", "id": 2, "bucket": "cfdpDown"}],
        "remoteEntities": [{"name": "flight", "id": 1}],
    },
}
STREAMS = """\
create stream cfdp_in as select packet as pdu from cfdp_tm
create stream cfdp_out (gentime TIMESTAMP, entityId long, seqNum int, pdu binary)
insert into cfdp_tc select gentime, 'cfdp' as origin, seqNum, '/cfdp' as cmdName, pdu as binary from cfdp_out
"""


class Wire:
    """PDUs to and from Yamcs, one a datagram, some lost."""

    def __init__(self, yamcs: Yamcs, udp: socket.socket, port: int):
        self.yamcs, self._udp, self._port, self._rng = yamcs, udp, port, random.Random(1)

    def exchange(self, pdu: bytes | None) -> list[bytes]:
        """Send a PDU, if there is one, and return those that came."""
        if pdu is not None and self._rng.random() >= LOSS:
            self._udp.sendto(pdu, ("127.0.0.1", self._port))
        time.sleep(0.001 if pdu is not None else 0.005)
        came = []
        with contextlib.suppress(BlockingIOError):
            while True:
                came.append(self._udp.recv(65_536))
        return [one for one in came if self._rng.random() >= LOSS]


@pytest.fixture(scope="module")
def wire(tmp_path_factory) -> Iterator[Wire]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.setblocking(False)
        port, _ = free_ports()

        def add_service(folder: Path) -> None:
            file = folder / "etc/yamcs.obbgs.yaml"
            config = yaml.safe_load(file.read_text())
            config["services"].append(SERVICE)
            of_packets = "packetPreprocessorClassName", "packetPreprocessorArgs"
            link = {key: config["dataLinks"][0][key] for key in of_packets}
            link[of_packets[1]] = {"timestampOffset": -1, "seqCountOffset": -1}
            link |= {
                "name": "cfdp_tm",
                "class": "org.yamcs.tctm.UdpTmDataLink",
                "stream": "cfdp_tm",
                "port": port,
            }
            back = {"name": "cfdp_tc", "class": "org.yamcs.tctm.UdpTcDataLink", "stream": "cfdp_tc"}
            config["dataLinks"] += [link, back | {"host": "127.0.0.1", "port": udp.getsockname()[1]}]
            streams = config["streamConfig"]
            streams["tm"].append({"name": "cfdp_tm"})
            streams["tc"].append("cfdp_tc")
            streams["sqlFile"] = "etc/streams.sql"  # after the streams that it reads
            (folder / "etc/streams.sql").write_text(STREAMS)
            file.write_text(yaml.safe_dump(config, sort_keys=False))

        with running_yamcs(tmp_path_factory.mktemp("cfdp") / "server", add_service) as yamcs:
            yield Wire(yamcs, udp, port)


@pytest.fixture
def files(make_frame) -> dict[str, bytes]:
    return {f"{n:08d}.obf": encode_frame(make_frame(n)) for n in range(6)}


def test_our_files_reach_yamcs_intact(wire: Wire, files):
    sender = Sender(MAX_PDU_BYTES, INTERVAL_S, checksum="modular")
    waiting, delivered, number = list(files), set(), 0
    end_s = time.monotonic() + TIMEOUT_S
    while delivered != set(files) and time.monotonic() < end_s:
        while waiting and sender.has_room:
            name, number = waiting.pop(0), number + 1
            sender.put(name, files[name], number, time.monotonic())
        for answer in wire.exchange(sender.next_pdu(time.monotonic())):
            sender.receive(answer, time.monotonic())
        for outcome in sender.outcomes():
            if outcome.delivered:
                delivered.add(outcome.name)
            else:
                waiting.append(outcome.name)
    assert delivered == set(files)
    for name, content in files.items():
        assert wire.yamcs.download(f"/storage/buckets/cfdpDown/objects/{name}") == content


def test_files_of_yamcs_reach_us_intact(wire: Wire, files):
    stored: dict[str, bytes] = {}

    def accept(name: str, content: bytes) -> bool:
        stored[name] = content
        return True

    receiver = Receiver(MAX_PDU_BYTES, INTERVAL_S, accept, route=UPLINK, checksum="modular")
    wire.yamcs.ask("/storage/buckets", {"name": "up"})
    for name, content in files.items():
        wire.yamcs.upload(f"/storage/buckets/up/objects/{name}", content)
        transfer = {"direction": "UPLOAD", "bucket": "up", "objectName": name, "remotePath": name}
        ends = {"source": "ground", "destination": "flight", "options": {"reliable": True}}
        wire.yamcs.ask("/filetransfer/obbgs/cfdp/transfers", transfer | ends)
    end_s = time.monotonic() + TIMEOUT_S
    while set(stored) != set(files) and time.monotonic() < end_s:
        for pdu in wire.exchange(receiver.next_pdu(time.monotonic())):
            receiver.receive(pdu, time.monotonic())
    assert stored == files
