"""Checks of the flight computer: clock, disk, speed and memory, and the key's files."""

import contextlib
import ctypes
import errno
import os
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from sgp4.api import Satrec

from flightsw.downlink.commands import ReplayCounter
from flightsw.icd.config import ConfigError
from flightsw.icd.frame import Frame, PoseTag, encode_frame
from flightsw.icd.mission import Mission
from flightsw.icd.reference_frames import DAY_NS, UNIX_EPOCH_JD
from flightsw.selftest.finding import Finding
from obbgs_base.errors import reason
from obbgs_base.files import write_whole

NS = 1_000_000_000
STEADY_S = 0.25  # over which the two clocks are compared
STEP_S = 0.01  # that one may gain on the other meanwhile: more is a step, not a correction by NTP
OFFSET_S = 0.1  # that a synchronised clock may still be wrong, by its own estimate
MEMORY_BYTES = 150_000_000  # that `flightsw serve` with a model for triage takes
TIME_ERROR, STA_UNSYNC = 5, 0x40  # of adjtimex: the clock is not synchronised (sys/timex.h)
TIMEX_LONGS = 64  # more than struct timex has


def check_clock(mission: Mission) -> list[Finding]:
    """Check that the clock can be right, runs steadily and is synchronised; exposures are tagged by it."""
    now_ns = time.time_ns()
    now = datetime.fromtimestamp(now_ns / NS, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    epoch_ns = max(map(_epoch_ns, (mission.orbit.target_tle, mission.orbit.chaser_tle)))
    findings = []
    if now_ns < epoch_ns - DAY_NS:
        newest = datetime.fromtimestamp(epoch_ns / NS, UTC).strftime("%Y-%m-%d")
        advice = "set the clock (chronyc makestep, or timedatectl set-time), then check its battery"
        findings.append(Finding.failed("clock", f"says {now}, before the elements of {newest}", advice))
    before = time.monotonic(), time.time()
    time.sleep(STEADY_S)
    after = time.monotonic(), time.time()
    gain_s = (after[1] - before[1]) - (after[0] - before[0])
    if abs(gain_s) > STEP_S:
        found = f"stepped by {gain_s:+z.3f} s within {STEADY_S} s"
        findings.append(
            Finding.failed("clock", found, "wait until its synchronisation has settled, and test again")
        )
    synchronised, error_s = synchronisation()
    if not synchronised:
        advice = (
            "start chronyd, systemd-timesyncd or PTP, or set the clock by hand: a second is a second of orbit"
        )
        findings.append(Finding.warning("clock", "is not synchronised with any source of time", advice))
    elif error_s > OFFSET_S:
        found = f"is synchronised, but may be wrong by {error_s:.3f} s"
        findings.append(Finding.warning("clock", found, "wait until its synchronisation has settled"))
    if not findings:
        findings.append(
            Finding.ok("clock", f"{now}, steady, synchronised to {1e3 * error_s:.1f} ms by its own estimate")
        )
    return findings


def synchronisation() -> tuple[bool, float]:
    """Return whether the kernel counts its clock as synchronised, and its estimate of the error, seconds."""
    timex = (ctypes.c_long * TIMEX_LONGS)()  # modes 0: nothing is changed
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    # modes, offset, freq, maxerror, esterror, status: the two ints lie in longs of their own
    status = timex[5] & 0xFFFFFFFF
    return state not in (-1, TIME_ERROR) and not status & STA_UNSYNC, timex[4] * 1e-6


def check_disk(mission: Mission, store: Path) -> list[Finding]:
    """Check that frames can be written where the store will be, and that there is room for the pass."""
    folder = store
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        advice = "name another --store, or move the file away"
        return [Finding.failed("disk", f"{folder} cannot be written: it is no folder", advice)]
    frame_bytes = _frame_bytes(mission)
    bracket = mission.bracket
    per_bracket = frame_bytes * len(bracket.exposure_times_ms)
    free_bytes = shutil.disk_usage(folder).free
    if mission.store.quota_bytes is not None:
        free_bytes = min(free_bytes, mission.store.quota_bytes)
    room = f"{folder}: room for {_mb(free_bytes)} MB, the pass takes {_mb(per_bracket * bracket.count)}"
    more_room = "free space, raise the quota, or take fewer brackets"
    probe = folder / f".selftest-{os.getpid()}"
    content = os.urandom(min(1 << 20, max(free_bytes // 4, 1)))  # it stands there twice for a moment
    try:
        started_s = time.monotonic()
        write_whole(probe, content)
        write_whole(probe, content)  # over the first: the rename that replaces a file
        elapsed_s = time.monotonic() - started_s
        came_back = probe.read_bytes() == content
        probe.unlink()
    except OSError as error:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
        advice = "mount the disk for writing, give this user the folder (chown), or name another --store"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = more_room
        return [Finding.failed("disk", f"{folder} cannot be written: {reason(error)}", advice)]
    if not came_back:
        advice = "replace the disk: it does not keep what is written"
        return [Finding.failed("disk", f"{folder} returned other bytes than were written", advice)]
    if free_bytes < per_bracket:
        return [Finding.failed("disk", f"{room} MB: not even one bracket fits", more_room)]
    if free_bytes < per_bracket * bracket.count:
        return [Finding.warning("disk", f"{room} MB uncompressed", more_room)]
    return [
        Finding.ok("disk", f"{room} MB at most; wrote {2e-6 * len(content) / elapsed_s:.0f} MB/s, atomically")
    ]


def check_computer(mission: Mission) -> list[Finding]:
    """Check that a bracket is coded in the time to the next one, and that memory is left."""
    started_s = time.process_time()
    encode_frame(_noise(mission))
    seconds = (time.process_time() - started_s) * len(mission.bracket.exposure_times_ms)
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    available_bytes = _available_bytes()
    found = (
        f"codes a bracket in {1e3 * seconds:.0f} ms of {mission.bracket.interval_s:g} s, load {load:.0%} of its cores, "
        f"{available_bytes / 1e6:.0f} MB of memory left"
    )
    if seconds > mission.bracket.interval_s:
        advice = "lengthen bracket.interval_s, or take smaller pictures"
        return [Finding.failed("computer", f"{found}: too slow", advice)]
    if available_bytes < MEMORY_BYTES:
        advice = f"stop other programs: flightsw takes up to {MEMORY_BYTES / 1e6:.0f} MB"
        return [Finding.failed("computer", f"{found}: too little memory", advice)]
    if load > 1:
        return [Finding.warning("computer", found, "look for other programs with `top`")]
    return [Finding.ok("computer", found)]


def check_key(key_file: Path) -> list[Finding]:
    """Check that commands can be taken with a key: its file, its counter, and that no other process has it."""
    try:
        counter = ReplayCounter(key_file)
    except ConfigError as error:
        advice = "copy both files of `ground key` here, readable by this user, and stop other flight software"
        return [Finding.failed("key", str(error), advice)]
    counter.close()
    if key_file.stat().st_mode & 0o077:
        found = f"{key_file} can be read by other users"
        return [Finding.warning("key", found, f"chmod 600 {key_file}")]
    return [Finding.ok("key", f"number {counter.key.spi}, last command {counter.last}")]


def _epoch_ns(tle: tuple[str, ...]) -> int:
    satellite = Satrec.twoline2rv(*tle)
    return round((satellite.jdsatepoch - UNIX_EPOCH_JD + satellite.jdsatepochF) * DAY_NS)


def _mb(size_bytes: float) -> str:
    return f"{size_bytes / 1e6:.0f}" if size_bytes >= 1e7 else f"{size_bytes / 1e6:.2g}"


def _frame_bytes(mission: Mission) -> int:
    camera = mission.camera
    return 2 * camera.width * camera.height * camera.channels


def _noise(mission: Mission) -> Frame:
    """Return a frame of noise, the slowest to code."""
    camera = mission.camera
    shape = (camera.height, camera.width) + ((3,) if camera.channels == 3 else ())
    dn = np.random.default_rng(0).integers(0, camera.white_dn + 1, shape, dtype=np.uint16)
    pose = PoseTag(np.array([1.0, 0, 0, 0]), np.zeros(3), np.eye(6), np.array([0.0, 0, 1]), False, False)
    return Frame(0, 0, 0, 1, 1e-3, 0, pose, dn, camera.bit_depth, camera.black_dn, 0)


def _available_bytes() -> int:
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
