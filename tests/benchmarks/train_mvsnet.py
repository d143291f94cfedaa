"""Trains a small MVSNet on ray-cast boxes, to try the baseline `mvsnet` where no published weights are at hand.

    python -m tests.benchmarks.train_mvsnet --out weights.pt

The weights say of themselves that they were trained here; they are not those of any publication. A box spacecraft with
random textures is seen from within 25 degrees, in brackets, with noise; the true depths are those of the ray caster.
"""

import argparse
import dataclasses
import io
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from compare.opponents.mvsnet import network_input
from compare.opponents.mvsnet_network import STRIDE, MvsNet
from compare.opponents.stereo_views import View, depth_range_m, neighbours, prepare
from obbgs_base.files import write_whole
from tests import raycast

RANGE_M, NARROW_DEG = 4.5, 25.0
SIZE_PX, CROP_PX, ENLARGED, SOURCES, PLANES = (
    112,
    64,
    2,
    3,
    32,
)  # pictures are enlarged as `mvsnet.NetworkSettings` does to 200 px
RATE = 1e-3  # of Adam, falling to zero


@dataclasses.dataclass(frozen=True)
class Example:
    """A reference's crop and its neighbours as the network sees them, and the true depths [h, w] m, 0 in the sky."""

    views: list[View]
    depths_m: Tensor  # [D] of the planes
    truth_m: Tensor


def examples(
    scenes: int, views: int, size_px: int, seed: int, crop_px: int = CROP_PX, planes: int = PLANES
) -> list[Example]:
    """Return one example for each of some views of random spacecraft."""
    rng, made = np.random.default_rng(seed), []
    for scene in range(scenes):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        poses = raycast.looking_at_origin(raycast.directions(views, NARROW_DEG) @ turn, RANGE_M)
        boxes = raycast.spacecraft(1000 * seed + scene)
        frames, truth = raycast.photographed(boxes, poses, size_px, 2.0 * size_px, scene)
        seen = prepare(frames, raycast.SENSOR, one_exposure=True)
        if len(seen.views) < len(
            frames
        ):  # a dark view has no example, and the others would shift against their depths
            continue
        for i, sources in enumerate(neighbours(seen, SOURCES)):
            crop, depth_m = _cropped(seen.views[i], truth[i], crop_px, rng)
            depths_m = torch.linspace(*depth_range_m(crop, seen.radius_m), planes)
            inputs = [network_input(view, ENLARGED) for view in (crop, *(seen.views[j] for j in sources))]
            made.append(Example(inputs, depths_m, depth_m))
    return made


def _cropped(view: View, truth_m: np.ndarray, crop_px: int, rng: np.random.Generator) -> tuple[View, Tensor]:
    """Return a square of a view around a random pixel of the target, and the true depths at the features' pixels."""
    size = min(crop_px, *truth_m.shape)
    row, column = rng.choice(np.argwhere(truth_m > 0))
    top, left = (
        int(np.clip(at - size // 2, 0, most - size))
        for at, most in zip((row, column), truth_m.shape, strict=True)
    )
    K = view.K.clone()
    K[:2, 2] -= torch.tensor([left, top])
    square = np.s_[..., top : top + size, left : left + size]
    crop = View(view.image[square], view.full_scale, view.lit[square], view.world_to_camera, K)
    at = (
        torch.arange(size * ENLARGED // STRIDE) * STRIDE // ENLARGED
    )  # where the features' pixels are centred
    return crop, torch.from_numpy(truth_m[square])[at][:, at].float()


def loss_of(network: MvsNet, example: Example) -> Tensor:
    """Return the mean smooth L1 error of the depths on the target, in units of the distance of two planes."""
    depth_m, _ = network(example.views, example.depths_m)
    on = example.truth_m > 0
    step_m = example.depths_m[1] - example.depths_m[0]
    return F.smooth_l1_loss(depth_m[on] / step_m, example.truth_m[on] / step_m)


def train(network: MvsNet, made: list[Example], steps: int, seed: int, rate: float = RATE) -> list[float]:
    """Train a network in place, one example a step, and return the losses."""
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / steps)
    order, losses = torch.Generator().manual_seed(seed), []
    network.train()
    for _ in range(steps):
        loss = loss_of(network, made[int(torch.randint(len(made), (1,), generator=order))])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    network.eval()
    return losses


def checkpoint(network: MvsNet, description: str) -> bytes:
    """Return the file of a network's weights."""
    content = io.BytesIO()
    torch.save({"model": network.state_dict(), "description": description}, content)
    return content.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--width", type=int, default=4, help="channels of the first layer; published: 8")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    started = time.process_time()
    made = examples(arguments.scenes, 9, SIZE_PX, arguments.seed)
    print(f"{len(made)} examples after {time.process_time() - started:.0f} s of CPU", flush=True)
    network, losses = MvsNet(arguments.width), []
    losses = train(network, made, arguments.steps, arguments.seed)
    fresh = examples(2, 9, SIZE_PX, arguments.seed + 1)
    with torch.no_grad():
        unseen = sum(loss_of(network, example).item() for example in fresh) / len(fresh)
    tenth = max(1, len(losses) // 10)
    what = (
        f"trained on {len(made)} views of random boxes here, {arguments.steps} steps, width {arguments.width}"
    )
    write_whole(arguments.out, checkpoint(network, what))
    print(
        f"{what}: loss {np.mean(losses[:tenth]):.2f} at the start, {np.mean(losses[-tenth:]):.2f} at the end, "
        f"{unseen:.2f} planes on other spacecraft; {time.process_time() - started:.0f} s of CPU"
    )


if __name__ == "__main__":
    main()
