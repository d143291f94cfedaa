"""What several packages' tests need: a mission and frames for it."""

import fcntl
import gc
import importlib.util
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import skyfield.api

from flightsw.cameras.aravis import aravis
from flightsw.errors import CaptureError
from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import Mission, load_mission

SIZE_PX = 48
os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # before torch: threads that spin are 20 times slower on busy cores
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if WORKERS > 1:  # they share the cores: tests of several threads ask for them
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // WORKERS)))
hypothesis.settings.register_profile("obbgs", deadline=None)  # timings live in benchmarks
hypothesis.settings.load_profile("obbgs")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Import everything without the garbage collector, and let it pass over all that in the tests.

    Imports make objects by the million and hardly any garbage, and looking through them took seconds in each worker.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture
def small_mission(tmp_path: Path) -> Mission:
    """The demo's mission with a 48x48 camera."""
    text = (Path(__file__).parents[1] / "mission.yaml").read_text()
    path = tmp_path / "small.yaml"
    path.write_text(
        text.replace("width: 256", f"width: {SIZE_PX}").replace("height: 256", f"height: {SIZE_PX}")
    )
    return load_mission(path)


@pytest.fixture
def make_frame() -> Callable[..., Frame]:
    """Makes frames of noise: every bit of the codestream counts."""

    def make(frame_id: int = 0, size_px: int = SIZE_PX, channels: int = 1) -> Frame:
        rng = np.random.default_rng(frame_id)
        shape = (size_px, size_px) if channels == 1 else (size_px, size_px, channels)
        quat = rng.normal(size=4)
        root = rng.normal(size=(6, 6))
        pose = PoseTag(
            quat_body_to_camera=quat / np.linalg.norm(quat),
            position_body_m=rng.normal(size=3) * 400,
            covariance=root @ root.T,
            sun_dir_body=np.array([0.6, 0.0, 0.8]),
            in_eclipse=False,
            valid=True,
        )
        dn = rng.integers(0, 4096, shape, dtype=np.uint16)
        return Frame(
            frame_id=frame_id,
            bracket_id=frame_id // 3,
            bracket_index=frame_id % 3,
            bracket_count=3,
            exposure_time_s=1e-4,
            mid_exposure_utc_ns=1_784_631_150_000_000_000 + frame_id,
            pose=pose,
            dn=dn,
            bit_depth=12,
            black_dn=64.0,
            saturated_count=int((dn == 4095).sum()),
        )

    return make


@pytest.fixture
def use_threads() -> Iterator[Callable[[int], None]]:
    """Sets PyTorch's number of threads, which is set back after the test."""
    import torch  # here, since tests of the flight software do without

    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def skyfield_oracle():
    """Skyfield's time scale and the whole DE421, of which flight carries an excerpt."""
    spec = importlib.util.find_spec("skyfield_data")
    assert spec and spec.origin
    ephemeris = skyfield.api.Loader(str(Path(spec.origin).parent / "data"))("de421.bsp")
    yield skyfield.api.load.timescale(builtin=True), ephemeris
    ephemeris.close()


@pytest.fixture
def the_only_camera_on_loopback() -> Iterator[None]:
    """GigE Vision has one port, 3956: two test runs on one machine take turns."""
    try:
        aravis()
    except CaptureError as error:
        pytest.skip(str(error))
    with open(Path(tempfile.gettempdir()) / "obbgs-gige-test.lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
