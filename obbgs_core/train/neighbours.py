"""A prior for smooth surfaces: neighbours whose normals nearly agree are turned towards each other.

Under Lambert's law the brightness of a Gaussian depends on its normal, and few Suns are seen from few sides: a face
whose Gaussians each lean a little their own way looks even under the Suns of the training and patchy under others.
"""

from dataclasses import dataclass

import torch
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.highlights import shortest_axes

COUNT = 8  # neighbours of a Gaussian
INTERVAL = 20  # steps between two searches for them
EDGE_SINE_SQUARED = 0.02  # of the angle, 8 degrees, at which the cost is half of the largest


@dataclass
class Neighbours:
    """The nearest neighbours of each Gaussian; Gaussians move slowly, so they are kept for some steps."""

    # [N, 8] indices, fewer where there are fewer Gaussians; None: not searched yet
    nearest: Tensor | None = None

    def of(self, gaussians: Gaussians, step: int) -> Tensor:
        """Return the indices [N, 8] of the Gaussians whose centres are nearest to each one's."""
        if self.nearest is None or len(self.nearest) != len(gaussians) or step % INTERVAL == 0:
            centres = gaussians.means.detach().nan_to_num().numpy()
            _, found = KDTree(centres).query(centres, k=min(COUNT + 1, len(centres)))
            self.nearest = torch.from_numpy(found.reshape(len(centres), -1)[:, 1:])  # without itself
        return self.nearest


def normals_apart(gaussians: Gaussians, nearest: Tensor) -> Tensor:
    """Return how far neighbours' normals are apart, 0 to 1: the mean of s² / (s² + 0.02), s the sine of their angle.

    The pull is strongest at 5 degrees and falls beyond, so that edges stay. The normal is the shortest axis and has no
    sign: the two sides of a plate agree.

    Args:
        nearest: [N, K], the neighbours of each Gaussian.
    """
    if nearest.numel() == 0:
        return torch.zeros(())
    normals = shortest_axes(gaussians)
    sine_squared = 1 - (normals[:, None] * normals[nearest]).sum(dim=2).square()
    return (sine_squared / (sine_squared + EDGE_SINE_SQUARED)).mean()
