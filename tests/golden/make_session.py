"""Makes tests/golden/session: one small simulated pass, so that most tests need no Blender.

Run on purpose, never to silence a failing test: python tests/golden/make_session.py (needs Blender, about a minute).
"""

import shutil
import tempfile
from pathlib import Path

from flightsw.cameras import open_camera
from flightsw.capture.sequencer import capture
from flightsw.icd.frame import decode_frame
from flightsw.icd.mission import load_mission
from flightsw.storage.store import FrameStore
from ground.session.writer import SessionWriter
from hil.cameras.virtual import CameraServer
from hil.sky import SHIPPED
from hil.sky.render_farm import RenderFarm
from hil.truth import write_truth
from hil.world.scenario import true_exposures

HERE = Path(__file__).parent


def main() -> None:
    mission = load_mission(HERE / "mission.yaml")
    session = HERE / "session"
    shutil.rmtree(session, ignore_errors=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        RenderFarm(mission, SHIPPED, Path(folder) / "r") as farm,
    ):
        farm.prerender([e.pose for e in true_exposures(mission)])
        store = FrameStore(Path(folder) / "store")
        with CameraServer(mission, farm.radiance, Path(folder) / "camera.sock", seed=1) as server:
            camera = open_camera(server.url, mission.camera)
            print(capture(mission, camera, store))
            camera.close()
        writer = SessionWriter(session, mission)
        for stored in store.frames:
            container = store.read(stored.frame_id)
            writer.add(decode_frame(container), container)
        writer.save({}, sum(stored.size_bytes for stored in store.frames))
        write_truth(session, mission, farm, points=8000)


if __name__ == "__main__":
    main()
