"""Checks of what is connected: a bracket from the camera, and bytes over the link."""

import time

import numpy as np

from flightsw.cameras import open_camera
from flightsw.cameras.camera import Camera, Exposure
from flightsw.errors import CaptureError
from flightsw.icd.link.can import FLIGHT_SIDE, GROUND_SIDE
from flightsw.icd.link.framing import Deframer, frame_packet
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.mission import CameraSection, Mission
from flightsw.icd.packet import TELEMETRY, pack_packet
from flightsw.ports import Link, LinkError, open_link
from flightsw.ports.serial_port import END_OTHER
from flightsw.selftest.finding import Finding
from obbgs_base.errors import counted

NS = 1_000_000_000
IDLE_APID = 0x7FF  # packets that every receiver ignores (CCSDS 133.0-B)
ECHO_S = 2.0  # for the last byte to come back
LOOP_S = 2.0  # of sending, at most
ADAPTER_S = 0.5  # for an slcan adapter's first answer
BITS_PER_BYTE = 10  # on a serial line
SIGMAS = 6.0  # of noise: none of a picture's pixels lies so far out by chance
TIME_TOLERANCE = 0.1  # of an exposure time
SPACING_S = 0.5  # from one exposure of the tested bracket to the next, at most
CLOCK_S = 1.0  # between the asked and the stated time of an exposure
DARK_PERCENTILE, LIT_PERCENTILE = 1.0, 99.9  # of pixels: a dead or a hot pixel proves nothing


def check_link(url: str, loopback: bool, max_packet_bytes: int) -> list[Finding]:
    """Check that a link opens and takes packets, and, with `loopback`, that they come back unchanged.

    On a serial line a plug returns them, on a CAN interface a second socket of this program. An slcan adapter can only
    be asked whether it answers.

    Raises:
        ConfigError: the URL is not usable.
    """
    parsed = parse_link_url(url)
    try:
        link = open_link(url, FLIGHT_SIDE)
    except LinkError as error:
        if parsed.scheme == "can":
            advice = (
                "look whether the interface is there and up (ip link); modprobe loads what the kernel lacks"
            )
        else:
            advice = "look at the device's name (ls -l /dev) and give this user the group dialout"
        return [Finding.failed("link", error.problem, END_OTHER if error.remedy == END_OTHER else advice)]
    with link:
        if parsed.scheme == "serial":
            return [_looped(link, parsed.device, loopback, max_packet_bytes)]
        if parsed.scheme == "slcan":
            return [_adapter(link, parsed.device, loopback)]
        if loopback:
            with open_link(url, GROUND_SIDE) as other:
                return [_through_interface(link, other, parsed.device, max_packet_bytes)]
        found = f"{parsed.device} opens (--loopback tests the interface, the bus only the other side)"
        return [Finding.ok("link", found)]


def _idle_packets(baud_rate: float, max_packet_bytes: int) -> list[bytes]:
    """Return packets of random bytes that every receiver ignores, of several sizes, as many as the line is fast for."""
    rng = np.random.default_rng()
    room = int(LOOP_S * baud_rate / BITS_PER_BYTE)
    packets = []
    for size in (16, 64, 256, max_packet_bytes - 6, max_packet_bytes - 6):
        if not packets or room > 2 * size:
            packets.append(pack_packet(TELEMETRY, IDLE_APID, len(packets), rng.bytes(size)))
            room -= 2 * size
    return packets


def _adapter(link: Link, device: str, loopback: bool) -> Finding:
    """Look whether an slcan adapter answers the commands that open the bus."""
    if loopback:
        advice = "leave --loopback out, and start `ground listen` on the other side"
        return Finding.failed("link", "an slcan adapter returns nobody his own messages", advice)
    deadline_s = time.monotonic() + ADAPTER_S
    while time.monotonic() < deadline_s and not link.bytes_read:
        link.exchange(0.02)
    if link.losses["adapter_errors"]:
        found = f"{device}: the adapter refuses to open the bus"
        return Finding.failed(
            "link", found, "look at bit rate and fd in the URL, and at what the adapter can do"
        )
    answer = "the adapter answers" if link.bytes_read else "the adapter says nothing, as some do"
    return Finding.ok("link", f"{device} opens, {answer}; a CAN bus is tested by the other side only")


def _through_interface(link: Link, other: Link, device: str, max_packet_bytes: int) -> Finding:
    """Send idle packets to a second socket on a CAN interface, which returns them as the ground would send its own.

    The kernel passes frames on to other sockets once the controller has sent them, which takes another node that
    acknowledges them, or a controller in loop-back mode.
    """
    sent, returned = _idle_packets(link.baud_rate, max_packet_bytes), []
    there, back = Deframer(max_packet_bytes), Deframer(max_packet_bytes)
    waiting, answers, started_s = list(sent), [], time.monotonic()
    while time.monotonic() < started_s + LOOP_S + ECHO_S and len(returned) < len(sent) and link.connected:
        if waiting and link.ready:
            link.write(frame_packet(waiting.pop(0)))
        answers += there.feed(other.exchange(0.0))
        if answers and other.ready:
            other.write(frame_packet(answers.pop(0)))
        returned += back.feed(link.exchange(0.001))
    elapsed_s = time.monotonic() - started_s
    if sorted(returned) == sorted(sent):
        found = (
            f"{device}: {len(sent)} packets went through the interface and back in {1e3 * elapsed_s:.0f} ms"
        )
        return Finding.ok("link", found)
    if not link.connected or link.hang_ups:
        return Finding.failed("link", f"{device} hung up", "is the interface up (ip -details link show)?")
    found = f"{device}: {len(returned)} of {len(sent)} packets came back through the interface"
    advice = (
        "is the interface up, and is there another node on the bus to acknowledge frames, or is the controller in "
        "loop-back mode (ip link set can0 type can loopback on)? No `ground listen` may be on the bus meanwhile"
    )
    return Finding.failed("link", found, advice)


def _looped(link: Link, device: str, loopback: bool, max_packet_bytes: int) -> Finding:
    """Send idle packets of random bytes and look at what comes back."""
    sent = _idle_packets(link.baud_rate, max_packet_bytes)
    deframer, returned = Deframer(max_packet_bytes), []
    started_s = time.monotonic()
    for packet in sent:
        link.write(frame_packet(packet))
    deadline_s = started_s + LOOP_S + ECHO_S
    while time.monotonic() < deadline_s and returned != sent and link.connected:
        returned += deframer.feed(link.exchange(0.02))
    elapsed_s = time.monotonic() - started_s
    wiring = "look at plug, wiring and baud rate"
    if not link.connected or link.hang_ups:
        return Finding.failed("link", f"{device} hung up", f"{wiring}; is another program using the port?")
    if not link.ready:
        found = f"{device} does not take bytes: {link.bytes_written} in {elapsed_s:.1f} s"
        return Finding.failed("link", found, "look at the driver and at flow control")
    if returned == sent:
        found = f"{device}: {link.bytes_written} bytes came back unchanged in {1e3 * elapsed_s:.0f} ms"
        return Finding.ok("link", found)
    if loopback:
        if link.bytes_read == 0:
            found = f"{device}: none of {link.bytes_written} bytes came back"
            return Finding.failed("link", found, f"connect TX with RX by a loop-back plug; {wiring}")
        found = f"{device}: {len(returned)} of {len(sent)} packets came back whole"
        return Finding.failed("link", found, wiring)
    answer = f"{counted(link.bytes_read, 'byte')} came" if link.bytes_read else "nothing came"
    found = f"{device} opens and takes bytes; {answer} from the other side (--loopback tests with a plug)"
    return Finding.ok("link", found)


def check_camera(mission: Mission, url: str) -> list[Finding]:
    """Check that a camera takes one bracket of the mission, and that the pictures can be what they should be.

    Raises:
        ValueError: there is no driver for the URL.
    """
    try:
        camera = open_camera(url, mission.camera)
    except CaptureError as error:
        return [Finding.failed("camera", str(error), "look at power, cable and address of the camera")]
    try:
        exposures = _bracket(mission, camera)
    except CaptureError as error:
        return [
            Finding.failed("camera", f"took no bracket: {error}", "power-cycle the camera, and test again")
        ]
    finally:
        camera.close()
    for asked_s, exposure in exposures:
        if finding := _implausible(mission.camera, asked_s, exposure):
            return [finding]
    findings = _compared(mission.camera, exposures)
    if camera.packets_lost:
        advice = "set jumbo frames (ip link set mtu 9000), and nothing else on the camera's network"
        findings.append(Finding.warning("camera", f"lost {counted(camera.packets_lost, 'packet')}", advice))
    shortest, longest = (_signal_dn(mission.camera, exposures[i][1]) for i in (0, -1))
    times = ", ".join(f"{1e3 * asked_s:g}" for asked_s, _ in exposures)
    found = f"{times} ms: brightest {shortest:.0f} to {longest:.0f} DN above black"
    return findings or [Finding.ok("camera", found)]


def _bracket(mission: Mission, camera: Camera) -> list[tuple[float, Exposure]]:
    """Return the mission's exposure times, seconds, shortest first, with the exposures."""
    taken = []
    start_ns = mission.orbit.start_utc_ns if camera.has_own_clock else time.time_ns()
    times_s = sorted(mission.bracket.exposure_times_s)
    # in flight they may be spread over the time to the next bracket
    spacing_s = min(mission.bracket.spacing_s(), max(SPACING_S, times_s[-1]))
    for index, exposure_time_s in enumerate(times_s):
        due_ns = start_ns + round(index * spacing_s * NS)
        if not camera.has_own_clock:
            time.sleep(max(0.0, (due_ns - time.time_ns()) / NS))
        exposure = camera.expose(exposure_time_s, due_ns)
        late_s = (exposure.mid_exposure_utc_ns - due_ns) / NS - exposure_time_s / 2
        if abs(late_s) > CLOCK_S:
            raise CaptureError(f"an exposure is stamped {late_s:+z.3f} s beside the time it was asked for")
        taken.append((exposure_time_s, exposure))
    return taken


def _implausible(camera: CameraSection, asked_s: float, exposure: Exposure) -> Finding | None:
    """Return what is wrong with one exposure by itself."""
    name, dn = f"the exposure of {1e3 * asked_s:g} ms", exposure.dn
    expected = (camera.height, camera.width) + ((3,) if camera.channels == 3 else ())
    if dn.shape != expected or dn.dtype != np.uint16:
        found = f"{name} has {dn.shape} {dn.dtype}, the mission's camera {expected} uint16"
        return Finding.failed("camera", found, "correct camera, or the region set in the camera")
    if dn.max() > camera.white_dn:
        found = f"{name} reads up to {dn.max()}, {camera.bit_depth} bits end at {camera.white_dn}"
        return Finding.failed("camera", found, "correct camera.bit_depth, or the pixel format")
    if dn.min() == dn.max():
        found = f"{name} reads {dn.min()} everywhere"
        return Finding.failed("camera", found, "look at the sensor: not even noise is in the picture")
    if abs(exposure.exposure_time_s - asked_s) > TIME_TOLERANCE * asked_s:
        found = f"{name} took {1e3 * exposure.exposure_time_s:g} ms"
        return Finding.failed("camera", found, "ask for exposure times that the camera can take")
    dark_dn = float(np.percentile(dn, DARK_PERCENTILE))
    if dark_dn < camera.black_dn - SIGMAS * max(1.0, camera.read_noise_dn):
        found = f"{name}: the darkest hundredth reads {dark_dn:z.0f}, below the black level of {camera.black_dn:g}"
        return Finding.failed("camera", found, "calibrate camera.black_dn")
    return None


def _compared(camera: CameraSection, exposures: list[tuple[float, Exposure]]) -> list[Finding]:
    """Return what is wrong with the exposures beside each other."""
    means_dn = [float(exposure.dn.mean()) for _, exposure in exposures]
    noise_dn = SIGMAS * max(1.0, camera.read_noise_dn) / exposures[0][1].dn.size ** 0.5
    signal_dn = means_dn[0] - camera.black_dn
    if means_dn[-1] < means_dn[0] - noise_dn - TIME_TOLERANCE * max(signal_dn, 0):
        found = (
            f"the longest exposure is darker than the shortest: {means_dn[-1]:.1f} and {means_dn[0]:.1f} DN"
        )
        return [
            Finding.failed(
                "camera", found, "the camera does not obey exposure times: switch its automatic off"
            )
        ]
    if np.median(exposures[0][1].dn) >= camera.white_dn:
        found = "the shortest exposure is saturated over half of the picture"
        return [Finding.warning("camera", found, "shorten exposure_times_ms, or turn away from the light")]
    if _signal_dn(camera, exposures[-1][1]) < SIGMAS * max(1.0, camera.read_noise_dn):
        found = "takes brackets, but there is no light in the longest exposure"
        return [Finding.warning("camera", found, "is the lens cap on, the shutter closed, the view empty?")]
    return []


def _signal_dn(camera: CameraSection, exposure: Exposure) -> float:
    return float(np.percentile(exposure.dn, LIT_PERCENTILE)) - camera.black_dn
