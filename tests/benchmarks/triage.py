"""What triage is worth when a quarter of the frames comes down: python -m tests.benchmarks.triage --session DIR ...

DIR is the session/ of a `hil dataset`, with its truth; without one `--mesh` is rendered in `--scenario`. The whole pass
is on board. The oldest eighth of its frames comes down first and trains a first model; its ONNX export goes up, is
verified, and ranks the stored frames in the flight software's own worker and order until a quarter is down, in
`--rounds` with a new model each. Then one model is trained on each choice of as many frames, all else equal:

- triage: as above; residual: in the order of the residual alone; novelty: of the novelty of the view alone
- oldest, random, even (evenly spaced over the pass); even-after: the oldest eighth, then evenly spaced over the rest
- all: every frame, four times as many

random and even need not begin with the oldest eighth, as triage must. Scores are of held-out brackets of the whole pass
(every eighth, never on board here), without noise; geometry where the target's largest dimension is 2.
"""

import argparse
import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from flightsw.icd.frame import HEADER, Frame, PoseTag
from flightsw.storage.store import FrameStore
from flightsw.triage.scores import Ranked, sending_order, sent_view
from flightsw.triage.worker import ModelVerified, TriageWorker
from ground.run.model_files import SURFACE_POINTS
from ground.session.cameras import camera_of, exposed, sensor_of
from ground.session.folder import FrameRecord, Session, open_session
from ground.session.training_frames import split, training_frame
from ground.session.truth import Truth
from hil.dataset import DatasetConfig, make_dataset
from hil.sky import SHIPPED
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.io.onnx import export_onnx
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import cloud_distances, psnr_db
from obbgs_core.score.surface import surface_points
from obbgs_core.sensor import Sensor
from obbgs_core.train.trainer import train
from tests.benchmarks.rows import shown

FIRST, BUDGET = 8, 4  # an eighth comes down before there is a model, a quarter in all
RANKED_BY = ("triage", "residual", "novelty")
CHOICES = ("oldest", *RANKED_BY, "random", "even", "even-after", "all")


@dataclass(frozen=True)
class Pass:
    """The frames of a pass as flight has them and as training takes them, and the truth."""

    name: str
    session: Session
    sensor: Sensor
    on_board: list[FrameRecord]  # in the order of time
    training: dict[int, TrainingFrame]  # those on board that are not in eclipse and have a valid pose
    held_out: list[FrameRecord]
    truth: Truth


def load(folder: Path) -> Pass:
    """Return the pass in a session folder.

    Raises:
        SessionError: no such session, or one without truth.
    """
    session = open_session(folder)
    training, held_out = split(session)
    brackets = {record.bracket for record in held_out}
    return Pass(
        folder.resolve().parent.name,
        session,
        sensor_of(session.camera),
        [record for record in session.frames if record.bracket not in brackets],
        {record.id: training_frame(session, record) for record in training},
        held_out,
        Truth(session),
    )


def store_of(the_pass: Pass, folder: Path) -> FrameStore:
    """Return a flight store that holds the pass."""
    store = FrameStore(folder)
    of_bracket: dict[int, int] = {}
    for record in the_pass.on_board:
        of_bracket[record.bracket] = of_bracket.get(record.bracket, 0) + 1
    for record in the_pass.on_board:
        pose = PoseTag(
            record.quat_body_to_camera,
            record.position_body_m,
            record.covariance,
            record.sun_dir_body,
            record.in_eclipse,
            record.pose_valid,
        )
        store.put(
            Frame(
                record.id,
                record.bracket,
                record.bracket_index,
                of_bracket[record.bracket],
                record.exposure_time_s,
                record.mid_exposure_utc_ns,
                pose,
                the_pass.session.dn(record),
                record.bit_depth,
                record.black_dn,
                record.saturated,
            )
        )
    return store


def rank(worker: TriageWorker, store: FrameStore, model: Path, frame_ids: list[int]) -> list[Ranked]:
    """Return what the flight software's worker makes of stored frames with an uplinked model."""
    worker.verify(model)
    for frame_id in frame_ids:
        worker.rank(store.path(frame_id))
    results: list = []
    while len(results) < 1 + len(frame_ids):
        results += worker.results()
        time.sleep(0.01)
    verified, *ranked = results
    assert isinstance(verified, ModelVerified) and verified.problem is None, verified
    return [score for _, score in ranked]


def come_down(
    the_pass: Pass, store: FrameStore, choice: str, rounds: int, steps_share: float, seed: int
) -> list[int]:
    """Return the frames that come down within the budget by one of the rankings, in their order."""
    frame_ids = [record.id for record in the_pass.on_board]
    budget, down = len(frame_ids) // BUDGET, frame_ids[: len(frame_ids) // FIRST]
    camera, model = the_pass.session.camera, store.folder / "uplinked.onnx"
    worker = TriageWorker(np.array(camera.K), camera.width, camera.height)
    for round_ in range(rounds):
        gaussians = trained(the_pass, down, steps_share, seed)
        exposures_s = sorted({the_pass.training[i].exposure_time_s for i in down if i in the_pass.training})
        export_onnx(gaussians, the_pass.sensor, model, camera.width, camera.height, exposures_s)
        ranked = rank(worker, store, model, [i for i in frame_ids if i not in down])
        if choice == "residual":
            ordered = sorted(ranked, key=lambda r: (not r.comparable, -r.worst_chi2, r.frame_id))
        else:
            if choice == "novelty":
                ranked = [dataclasses.replace(r, worst_chi2=2.0) for r in ranked]
            views = [sent_view(store.read(i)[: HEADER.size]) for i in down]
            ordered = sending_order(ranked, [view for view in views if view is not None])
        down = down + [r.frame_id for r in ordered[: (budget - len(down)) // (rounds - round_)]]
    worker.stop()
    return down


def chosen(
    the_pass: Pass, store: FrameStore, choice: str, rounds: int, steps_share: float, seed: int
) -> list[int]:
    """Return the frames that come down by a choice."""
    if choice in RANKED_BY:
        return come_down(the_pass, store, choice, rounds, steps_share, seed)
    frame_ids = [record.id for record in the_pass.on_board]
    budget, first = len(frame_ids) // BUDGET, len(frame_ids) // FIRST
    if choice == "oldest":
        return frame_ids[:budget]
    if choice == "random":
        return sorted(np.random.default_rng(seed).choice(frame_ids, budget, replace=False).tolist())
    if choice == "even":
        return evenly(frame_ids, budget)
    if choice == "even-after":
        return frame_ids[:first] + evenly(frame_ids[first:], budget - first)
    return frame_ids


def evenly(frame_ids: list[int], count: int) -> list[int]:
    """Return so many of the frames, evenly spaced, the first and the last among them."""
    return [frame_ids[i] for i in np.linspace(0, len(frame_ids) - 1, count).round().astype(int)]


def trained(the_pass: Pass, frame_ids: list[int], steps_share: float, seed: int) -> Gaussians:
    """Return the model trained on those of the frames that can be used."""
    frames = [the_pass.training[i] for i in sorted(frame_ids) if i in the_pass.training]
    return train(
        frames,
        the_pass.sensor,
        preset("obbgs", {"steps": max(1, round(preset("obbgs").steps * steps_share))}),
        seed,
    ).gaussians


@torch.no_grad()
def figures(the_pass: Pass, gaussians: Gaussians) -> dict[str, float]:
    """Return clean PSNR over the held-out views and of the worst of them, and the geometry."""
    psnrs_db = []
    for record in map(the_pass.truth.posed, the_pass.held_out):
        exact = exposed(
            torch.from_numpy(the_pass.truth.radiance(record)[0]), the_pass.sensor, record.exposure_time_s
        )
        radiance = render(gaussians, camera_of(the_pass.session, record)).radiance[0]
        psnrs_db.append(psnr_db(exposed(radiance, the_pass.sensor, record.exposure_time_s), exact))
    scale = 2 / the_pass.truth.largest_dimension_m
    cloud = the_pass.truth.cloud_m * scale
    cameras = cameras_of(list(the_pass.training.values()))
    points, _ = surface_points(gaussians, cameras, SURFACE_POINTS)
    surface = cloud_distances(points.double().numpy() * scale, cloud)["completeness"] if len(points) else 0.0
    return {
        "psnr_clean_db": sum(psnrs_db) / len(psnrs_db),
        "psnr_worst_db": min(psnrs_db),
        "chamfer": cloud_distances(gaussians.means.double().numpy() * scale, cloud)["chamfer"],
        "completeness_surface": surface,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--session", type=Path, nargs="+", help="sessions of `hil dataset`")
    parser.add_argument("--scenario", default="fly-around", help="what to render without --session")
    parser.add_argument("--mesh", type=Path, default=SHIPPED, help="its target; default the shipped one")
    parser.add_argument("--out", type=Path, default=Path("triage"), help="where to render")
    parser.add_argument("--choices", default="oldest,triage,random,even,even-after", help=", ".join(CHOICES))
    parser.add_argument("--rounds", type=int, default=1, help="models uplinked")
    parser.add_argument("--seeds", type=int, default=3, help="of training; random frames are drawn anew")
    parser.add_argument("--steps-share", type=float, default=0.5)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    choices = arguments.choices.split(",")
    if wrong := set(choices).difference(CHOICES):
        parser.error(f"--choices: expected some of {', '.join(CHOICES)}, got {', '.join(sorted(wrong))}")
    torch.set_num_threads(arguments.threads)
    sessions = arguments.session
    if not sessions:
        config = DatasetConfig(scenario=arguments.scenario, frames=120, size_px=200)
        folder = arguments.out / f"{arguments.mesh.stem}-{Path(arguments.scenario).stem}"
        make_dataset(config, arguments.mesh, folder, arguments.out / "renders")
        sessions = [folder / "session"]
    for session in sessions:
        the_pass = load(session)
        for seed in range(arguments.seeds):
            for choice in choices:
                with tempfile.TemporaryDirectory() as folder:
                    store = store_of(the_pass, Path(folder))
                    settings = (arguments.rounds, arguments.steps_share, seed)
                    frame_ids = chosen(the_pass, store, choice, *settings)
                gaussians = trained(the_pass, frame_ids, arguments.steps_share, seed)
                row: dict = {"pass": the_pass.name, "choice": choice, "seed": seed, "frames": len(frame_ids)}
                row |= {"in_eclipse": sum(i not in the_pass.training for i in frame_ids)}
                row |= {name: round(value, 4) for name, value in figures(the_pass, gaussians).items()}
                row |= {"gaussians": len(gaussians), "frame_ids": frame_ids}
                told = row if arguments.json else {k: v for k, v in row.items() if k != "frame_ids"}
                print(shown(told, "triage", arguments.json), flush=True)


if __name__ == "__main__":
    main()
