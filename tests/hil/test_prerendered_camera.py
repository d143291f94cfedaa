"""The simulated GigE camera with frames rendered beforehand, seen by a client of its own protocol code."""

import contextlib
import itertools
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from flightsw.cameras import open_camera
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import load_mission
from hil.cameras.gige import DESCRIPTION, GigeCameraServer
from hil.world.scenario import true_exposures
from tests.gvsp_client import GvspClient
from tests.hil.test_gige import fake_camera, simulated

ROOT = Path(__file__).parents[2]
LONG_S = 60.0  # more than any of this takes
pytestmark = pytest.mark.usefixtures("the_only_camera_on_loopback")


def test_a_client_that_runs_free_or_triggers_sees_the_moments_of_the_pass_over_and_over():
    mission = simulated()
    first_ns = mission.orbit.start_utc_ns + 5_000_000_000
    moments = [first_ns + k * 27_000_000_000 for k in range(4)]
    shown: list[np.ndarray] = []

    def sky(pose: PoseTag) -> np.ndarray:
        shown.append(pose.position_body_m)
        return np.full((96, 96, 1), 0.4)

    # the pass, 81 s, and an interval to its next beginning take 0.8 s
    with (
        GigeCameraServer(mission, sky, real_time=135.0, moments=moments) as server,
        GvspClient(DESCRIPTION) as client,
    ):
        client.set("ExposureTime", 200)
        client.set("AcquisitionFramePeriod", 20_000)
        client.set("TriggerMode", 0)
        client.set("AcquisitionStart", 1)
        free = []
        for picture in client.pictures(LONG_S):
            free.append(picture)
            stamps = [p.stamp_ns for p in free]
            if len(set(stamps)) == 4 and stamps[-1] == stamps[0] and (np.diff(stamps) < 0).any():
                break  # every moment was shown, and the pass has begun again
        client.set("TriggerMode", 1)
        list(client.pictures(0.5))  # what was under way
        signal_dn = {}
        for exposure_us in (50, 100, 200):
            client.set("ExposureTime", exposure_us)
            client.set("TriggerSoftware", 1)
            triggered = next(client.pictures(LONG_S))
            assert triggered.stamp_ns + exposure_us * 500 in moments
            signal_dn[exposure_us] = triggered.dn.mean() - 64
        assert client.lost_packets == client.incomplete == server.failures == 0
    assert {p.stamp_ns + 100_000 for p in free} == set(moments)
    for exposure_us, mean_dn in signal_dn.items():
        assert mean_dn == pytest.approx(0.4 * 4e7 * exposure_us / 1e6, rel=0.01)
    expected = {tuple(server.pose_at(moment).position_body_m) for moment in moments}
    assert {tuple(position) for position in shown} == expected
    one, again = free[0].dn, free[-1].dn
    assert one.shape == (96, 96) and (one != again).mean() > 0.5  # the same moment, other noise


def test_packets_that_never_come_are_counted_by_the_client():
    with fake_camera("-r", "100"), GvspClient(DESCRIPTION) as client:  # 10 % of Aravis' own camera's packets
        client.set("AcquisitionStart", 1)
        until_s = time.monotonic() + LONG_S
        while client.incomplete < 3 and time.monotonic() < until_s:
            assert not list(client.pictures(0.2))
        assert client.incomplete >= 3 and client.lost_packets > 10


def test_what_an_interrupted_prerendering_has_rendered_is_used_again(tmp_path):
    tree = yaml.safe_load((ROOT / "mission.yaml").read_text())
    tree["camera"] |= {"width": 64, "height": 64, "fx_px": 1650.0, "fy_px": 1650.0, "cx_px": 32, "cy_px": 32}
    tree["bracket"] |= {"count": 3}
    (tmp_path / "mission.yaml").write_text(yaml.safe_dump(tree))
    mission = load_mission(tmp_path / "mission.yaml")
    moments = {exposure.mid_exposure_utc_ns for exposure in true_exposures(mission)}
    cache = tmp_path / "renders"
    command = [str(Path(sys.executable).with_name("hil")), "camera", "--prerender"]
    command += ["--mission", str(tmp_path / "mission.yaml"), "--cache", str(cache)]

    @contextlib.contextmanager
    def start(*more: str) -> Iterator[subprocess.Popen]:
        process = subprocess.Popen(
            [*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=LONG_S)

    with start("--gige") as first:
        while not list(cache.glob("*.npz")):
            assert first.poll() is None, first.communicate()[1]
            time.sleep(0.005)
        first.send_signal(signal.SIGTERM)
        out, _ = first.communicate(timeout=LONG_S)
    kept = {path: path.stat().st_mtime_ns for path in cache.iterdir()}
    assert first.returncode and out == "" and 1 <= len(kept) < 9
    assert all(path.suffix == ".npz" for path in kept)
    with start("--gige") as second:
        assert second.stdout
        assert second.stdout.readline() == "gige://127.0.0.1\n"
        with GvspClient(DESCRIPTION) as client:
            client.set("ExposureTime", 100)
            client.set("AcquisitionStart", 1)
            client.set("TriggerMode", 0)
            pictures = list(itertools.islice(client.pictures(LONG_S), 5))
            assert client.lost_packets == 0
        second.send_signal(signal.SIGTERM)
        _, err = second.communicate(timeout=LONG_S)
    assert second.returncode == 0 and ", 0 failed" in err
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list(cache.iterdir())) == len(moments) == 9  # free running rendered nothing more
    assert all(p.stamp_ns + 50_000 in moments and p.dn.max() > 500 for p in pictures)
    with start() as third:  # our own protocol, whose clients give the times
        assert third.stdout
        camera = open_camera(third.stdout.readline().strip(), mission.camera)
        for true in true_exposures(mission)[:2]:
            start_ns = true.mid_exposure_utc_ns - round(true.exposure_time_s * 5e8)
            exposure = camera.expose(true.exposure_time_s, start_ns)
            assert exposure.mid_exposure_utc_ns == true.mid_exposure_utc_ns and exposure.dn.max() > 300
        camera.close()
    assert len(list(cache.iterdir())) == 9
