"""Motions refined on silhouettes: lit rays must pass through points that no other view sees as sky."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.attitude.motion import SPIN, attitudes
from obbgs_core.attitude.views import Views

RAYS = 32  # of each view
OTHERS = 12  # views that each ray is compared with
EDGE = 5  # cells: rays are taken where the light in a window of this width is least
SLOPE = 1.0  # a cell that is open to this share's inverse counts as open
STEP_RAD = 0.02  # root mean square turn of the target, of finite differences
TRIES = 6  # of a step, each more damped
LEAST_GAIN = 1e-3  # of the cost, by a step that another one follows
SHAPE_SIGMA = 0.7  # of their prior: moments differ by a factor of about two
RAY_SIGMA = 0.1  # of a ray's residual, for the weight of that prior and the damping


@dataclass(frozen=True)
class Rays:
    """P rays of each of N views, and the views that each is compared with.

    points: [N, P, D, 3] along each ray, in the axes of its camera.
    weight: [N, P].
    others: [N, J] indices of views.
    soft: [N, n, n] like `Views.open`, with a slope a cell wide outside the outline.
    """

    points: Tensor
    weight: Tensor
    others: Tensor
    soft: Tensor


def rays(views: Views, seed: int) -> Rays:
    """Return rays at the inner edge of each silhouette; the same seed takes the same ones."""
    rng = np.random.default_rng(seed)
    n, count = views.lit.shape[-1], len(views)
    inside = F.avg_pool2d(views.lit[:, None], EDGE, 1, EDGE // 2)[:, 0]
    order = torch.from_numpy(rng.random(inside.shape)).float() * 0.2 + inside + 10.0 * (views.lit < 0.5)
    chosen = order.flatten(1).topk(RAYS, largest=False).indices  # [N, P]
    weight = (views.lit.flatten(1).gather(1, chosen) >= 0.5).float()
    u, v = (chosen % n) + 0.5, torch.div(chosen, n, rounding_mode="floor") + 0.5
    x, y = (u - views.centre[:, :1]) / views.scale[:, None], (v - views.centre[:, 1:]) / views.scale[:, None]
    depths = views.world_to_camera[:, 2, 3:] + torch.arange(-1 + views.cell / 2, 1, views.cell)  # [N, D]
    z = depths[:, None, :].expand(-1, RAYS, -1)
    points = torch.stack([x[..., None] * z, y[..., None] * z, z], dim=-1)
    others = np.stack([_others(rng, i, count) for i in range(count)])
    return Rays(points, weight, torch.from_numpy(others), (SLOPE * views.open).clamp(max=1))


def _others(rng: np.random.Generator, index: int, count: int) -> np.ndarray:
    others = np.delete(np.arange(count), index)
    return np.sort(rng.choice(others, min(OTHERS, len(others)), replace=False))


def residuals(views: Views, rays: Rays, attitudes: Tensor) -> Tensor:
    """Return for each ray the least share of the other views that see sky at a point of it, [B, N·P], 0 to 1.

    Args:
        attitudes: [B, N, 3, 3] inertial to body axes.
    """
    n = views.lit.shape[-1]
    R, t = views.world_to_camera[:, :3, :3], views.world_to_camera[:, :3, 3]
    frames = torch.arange(len(views))[:, None]
    found = []
    for body in attitudes:
        to_camera = R @ body.transpose(-1, -2)  # [N, 3, 3]
        relative = to_camera[rays.others] @ to_camera.transpose(-1, -2)[:, None]  # [N, J, 3, 3]
        shift = t[rays.others] - (relative @ t[:, None, :, None])[..., 0]  # [N, J, 3]
        points = rays.points.flatten(1, 2)  # [N, P·D, 3]
        p = points[:, None] @ relative.transpose(-1, -2) + shift[:, :, None]  # [N, J, P·D, 3]
        uv = p[..., :2] / p[..., 2:] * views.scale[rays.others][..., None, None]
        uv = uv + views.centre[rays.others][:, :, None]
        sampled = F.grid_sample(
            rays.soft[rays.others].flatten(0, 1)[:, None],
            (uv * (2 / n) - 1).flatten(0, 1)[:, :, None],
            padding_mode="border",
            align_corners=False,
        )
        missed = 1 - sampled.view(len(frames), -1, *rays.points.shape[1:3]).mean(dim=1)  # [N, P, D]
        found.append((missed.amin(dim=-1) * rays.weight).flatten())
    return torch.stack(found)


def refined(views: Views, parameters: np.ndarray, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return motions [B, 3 or 8] moved downhill by Levenberg and Marquardt's method, and their costs [B] per ray."""
    chosen = rays(views, seed)
    tight = np.concatenate([np.zeros(SPIN), np.full(parameters.shape[1] - SPIN, 1 / SHAPE_SIGMA)])

    def evaluated(at: np.ndarray) -> np.ndarray:
        body = torch.from_numpy(attitudes(at, views.times_s)).float()
        missed = residuals(views, chosen, body).double().numpy() / RAY_SIGMA
        return np.concatenate([missed, at * tight], axis=1)

    found = [_descended(p, evaluated, views.times_s, steps) for p in parameters]
    return np.stack([p for p, _ in found]), np.array([c for _, c in found]) / float(chosen.weight.sum())


def cost(views: Views, attitudes: np.ndarray, seed: int = 0) -> float:
    """Return the cost per ray of any attitudes [N, 3, 3], as `refined` has it of a motion's."""
    chosen = rays(views, seed)
    missed = residuals(views, chosen, torch.from_numpy(attitudes)[None].float()).double() / RAY_SIGMA
    return float(missed.square().sum() / chosen.weight.sum())


def difference_steps(parameters: np.ndarray, times_s: np.ndarray, turn_rad: float) -> np.ndarray:
    """Return by how much to change each parameter of a motion to turn the target by `turn_rad`, root mean square."""
    small = np.full(len(parameters), 1e-3)
    small[:SPIN] /= np.abs(times_s).max()
    body = attitudes(np.concatenate([parameters[None], parameters + np.diag(small)]), times_s)
    turned = np.sqrt(((body[1:] - body[0]) ** 2).sum(axis=(2, 3)).mean(axis=1) / 2)  # small angles
    return np.minimum(small * turn_rad / np.maximum(turned, 1e-12), 50 * small)


def _descended(
    at: np.ndarray, evaluated: Callable[[np.ndarray], np.ndarray], times_s: np.ndarray, steps: int
) -> tuple[np.ndarray, float]:
    damping, size = 1e-2, len(at)
    value = evaluated(at[None])[0]
    for _ in range(steps):
        unit = difference_steps(at, times_s, STEP_RAD)
        moved = evaluated(np.concatenate([at + np.diag(unit), at - np.diag(unit)]))
        J = (moved[:size] - moved[size:]).T / 2
        H, g, cost = J.T @ J, J.T @ value, value @ value
        for _ in range(TRIES):
            step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-9), -g)
            tried = evaluated((at + step * unit)[None])[0]
            if tried @ tried < cost:
                break
            damping *= 6
        else:
            break
        at, value, damping = at + step * unit, tried, max(damping / 6, 1e-4)
        if cost - value @ value < LEAST_GAIN * cost:
            break
    return at, float(value @ value)


def spread(views: Views, parameters: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the covariance of refined parameters, from how much the views disagree on them.

    Rays of one view err together, so each view counts as one observation.

    Source: the sandwich estimator clustered by view (Liang and Zeger, Longitudinal data analysis using generalized
    linear models, 1986).
    """
    chosen, unit = rays(views, seed), difference_steps(parameters, views.times_s, STEP_RAD)
    at = np.concatenate([parameters[None], parameters + np.diag(unit), parameters - np.diag(unit)])
    body = torch.from_numpy(attitudes(at, views.times_s)).float()
    missed = residuals(views, chosen, body).double().numpy() / RAY_SIGMA
    size = len(parameters)
    J = ((missed[1 : size + 1] - missed[size + 1 :]).T / 2).reshape(len(views), -1, size)
    slopes = np.einsum("npk,np->nk", J, missed[0].reshape(len(views), -1))
    prior = np.concatenate([np.zeros(SPIN), np.full(size - SPIN, 1 / SHAPE_SIGMA**2)]) * unit**2
    inverse = np.linalg.pinv(np.einsum("npk,npl->kl", J, J) + np.diag(prior))
    return inverse @ (slopes.T @ slopes + np.diag(prior)) @ inverse * np.outer(unit, unit)
