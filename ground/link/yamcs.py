"""Writes a configuration of Yamcs, an open mission control system, that shows the telemetry which we forward to it.

One instance, `obbgs`: a link that receives space packets by UDP, the database of packets as XTCE, an archive and
alarms. There is no link for commands, on purpose: commands are sealed with the mission's key by `ground uplink` only.
"""

import secrets
import shutil
from pathlib import Path

from flightsw.icd.config import ConfigError
from ground.link.xtce.document import ROOT_CONTAINER, SYSTEM, xtce_document
from obbgs_base.errors import reason

TELEMETRY_PORT, WEB_PORT = 10015, 8090  # Yamcs' own defaults
MAX_PACKET_BYTES = 65_542  # of a space packet with its header

SERVER = """\
services:
  - class: org.yamcs.http.HttpServer
    args:
      address: 127.0.0.1  # Yamcs asks nobody for a password unless it is told to: see its manual before opening it
      port: {web_port}
instances:
  - {system}
dataDir: data
secretKey: {secret}
"""

INSTANCE = """\
services:
  - class: org.yamcs.archive.XtceTmRecorder
  - class: org.yamcs.archive.ParameterRecorder
  - class: org.yamcs.archive.AlarmRecorder
  - class: org.yamcs.archive.EventRecorder
  - class: org.yamcs.archive.ReplayServer
  - class: org.yamcs.archive.CommandHistoryRecorder
  - class: org.yamcs.parameterarchive.ParameterArchive
  - class: org.yamcs.parameter.SystemParametersService
  - class: org.yamcs.ProcessorCreatorService
    args:
      name: realtime
      type: realtime

dataLinks:
  # From `ground listen --forward udp://HOST:{port}`: one space packet in each datagram. There is no link for commands.
  - name: telemetry
    class: org.yamcs.tctm.UdpTmDataLink
    stream: tm_realtime
    port: {port}
    maxLength: {max_packet_bytes}
    packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
    packetPreprocessorArgs:
      timestampOffset: -1  # packets are filed under the time at which they came; each holds its own time as utc_ns
      seqCountOffset: 0  # the first four bytes: APID and count

mdb:
  - type: xtce
    args:
      file: mdb/{system}.xml
      autoTmPartitions: false

streamConfig:
  tm:
    - name: tm_realtime
      processor: realtime
      rootContainer: /{system}/{root_container}
  invalidTm: invalid_tm
  cmdHist:
    - cmdhist_realtime
  event:
    - events_realtime
  param:
    - pp_realtime
    - sys_param
    - proc_param
  parameterAlarm:
    - alarms_realtime
  eventAlarm:
    - event_alarms_realtime
  tc:
    - tc_realtime
"""

PROCESSORS = """\
realtime:
  services:
    - class: org.yamcs.StreamTmPacketProvider
    - class: org.yamcs.tctm.StreamParameterProvider
    - class: org.yamcs.algorithms.AlgorithmManager
    - class: org.yamcs.parameter.LocalParameterManager
  config:
    generateEvents: true
    subscribeAll: true
    alarm:
      parameterCheck: true
      parameterServer: enabled
      eventServer: enabled
Archive:
  services:
    - class: org.yamcs.tctm.ReplayService
    - class: org.yamcs.algorithms.AlgorithmManager
ParameterArchive:
  services:
    - class: org.yamcs.tctm.ReplayService
    - class: org.yamcs.algorithms.AlgorithmManager
ArchiveRetrieval:
  services:
    - class: org.yamcs.tctm.ReplayService
    - class: org.yamcs.algorithms.AlgorithmManager
"""

START = """\
#!/bin/sh
# Starts Yamcs with this configuration. It needs Java 17 and Yamcs 5.12 or newer: its distribution with `yamcsd` on the
# PATH, or a folder of its jars in YAMCS_LIB.
cd "$(dirname "$0")" || exit 1
if [ -n "$YAMCS_LIB" ]; then
  exec java -cp "$YAMCS_LIB/*" org.yamcs.YamcsServer --etc-dir etc --data-dir data "$@"
elif command -v yamcsd >/dev/null; then
  exec yamcsd --etc-dir etc --data-dir data "$@"
fi
echo "start.sh: expected yamcsd on the PATH or a folder of Yamcs' jars in YAMCS_LIB; get Yamcs from yamcs.org" >&2
exit 1
"""


def write_yamcs(folder: Path, port: int = TELEMETRY_PORT, web_port: int = WEB_PORT) -> None:
    """Write the configuration into a new folder, whole or not at all.

    Args:
        port: UDP port on which Yamcs waits for packets, on all of the machine's addresses.
        web_port: TCP port of its pages, on 127.0.0.1.

    Raises:
        ConfigError: the folder exists and is not empty, or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(str(folder), "exists and is not empty: give another folder, or remove it")
    values = {
        "system": SYSTEM,
        "root_container": ROOT_CONTAINER,
        "port": port,
        "web_port": web_port,
        "max_packet_bytes": MAX_PACKET_BYTES,
        "secret": secrets.token_hex(32),
    }
    files = {
        "etc/yamcs.yaml": SERVER.format(**values).encode(),
        f"etc/yamcs.{SYSTEM}.yaml": INSTANCE.format(**values).encode(),
        "etc/processor.yaml": PROCESSORS.encode(),
        f"mdb/{SYSTEM}.xml": xtce_document(),
        "start.sh": START.encode(),
    }
    part = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        for name, content in files.items():
            file = part / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        (part / "etc/yamcs.yaml").chmod(0o600)  # it holds a secret
        (part / "start.sh").chmod(0o755)
        part.replace(folder)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise ConfigError(str(folder), f"cannot be written: {reason(error)}") from error
