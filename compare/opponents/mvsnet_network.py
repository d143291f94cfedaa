"""A learned multi-view stereo network: features, a volume of their variances over planes, and soft-argmin depth.

Source: Yao et al., MVSNet: Depth Inference for Unstructured Multi-view Stereo, 2018. Layers are named and ordered as in
the public PyTorch version (MVSNet_pytorch), so that its checkpoints can be read.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from compare.opponents.plane_sweep import homography_terms, warp
from compare.opponents.stereo_views import View, pixel_rays

STRIDE = 4  # pixels of a picture along each side of a pixel of the depth map
PUBLISHED_WIDTH = 8  # channels of the first layer; all others are multiples of it
MULTIPLE = 8  # the volume is halved three times along each axis


class Convolution(nn.Module):
    """A convolution in 2 or 3 dimensions, batch normalisation, and ReLU."""

    def __init__(self, dimensions: int, before: int, after: int, kernel: int = 3, stride: int = 1):
        super().__init__()
        layers = {2: (nn.Conv2d, nn.BatchNorm2d), 3: (nn.Conv3d, nn.BatchNorm3d)}
        convolution, normalisation = layers[dimensions]
        self.conv = convolution(before, after, kernel, stride=stride, padding=kernel // 2, bias=False)
        self.bn = normalisation(after)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


def _transposed(before: int, after: int) -> nn.Sequential:
    convolution = nn.ConvTranspose3d(before, after, 3, padding=1, output_padding=1, stride=2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm3d(after), nn.ReLU())


class FeatureNet(nn.Module):
    """From pictures [V, 3, H, W] to features [V, 4 width, H / 4, W / 4]."""

    def __init__(self, width: int):
        super().__init__()
        self.conv0 = Convolution(2, 3, width)
        self.conv1 = Convolution(2, width, width)
        self.conv2 = Convolution(2, width, 2 * width, 5, 2)
        self.conv3 = Convolution(2, 2 * width, 2 * width)
        self.conv4 = Convolution(2, 2 * width, 2 * width)
        self.conv5 = Convolution(2, 2 * width, 4 * width, 5, 2)
        self.conv6 = Convolution(2, 4 * width, 4 * width)
        self.feature = nn.Conv2d(4 * width, 4 * width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv1(self.conv0(x))
        x = self.conv4(self.conv3(self.conv2(x)))
        return self.feature(self.conv6(self.conv5(x)))


class CostRegularization(nn.Module):
    """From the variances [1, 4 width, D, h, w] to a score [1, 1, D, h, w] of each plane; a U-Net in 3D."""

    def __init__(self, width: int):
        super().__init__()
        self.conv0 = Convolution(3, 4 * width, width)
        self.conv1 = Convolution(3, width, 2 * width, stride=2)
        self.conv2 = Convolution(3, 2 * width, 2 * width)
        self.conv3 = Convolution(3, 2 * width, 4 * width, stride=2)
        self.conv4 = Convolution(3, 4 * width, 4 * width)
        self.conv5 = Convolution(3, 4 * width, 8 * width, stride=2)
        self.conv6 = Convolution(3, 8 * width, 8 * width)
        self.conv7 = _transposed(8 * width, 4 * width)
        self.conv9 = _transposed(4 * width, 2 * width)
        self.conv11 = _transposed(2 * width, width)
        self.prob = nn.Conv3d(width, 1, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.conv0(x)
        middle = self.conv2(self.conv1(fine))
        coarse = self.conv4(self.conv3(middle))
        x = coarse + self.conv7(self.conv6(self.conv5(coarse)))
        x = middle + self.conv9(x)
        return self.prob(fine + self.conv11(x))


class MvsNet(nn.Module):
    """The network without its last refinement, which the published evaluation leaves out too."""

    def __init__(self, width: int = PUBLISHED_WIDTH):
        super().__init__()
        self.feature = FeatureNet(width)
        self.cost_regularization = CostRegularization(width)

    def forward(self, views: list[View], depths_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return depth [h, w] m of the first view at a quarter of its size, and the probability mass near it, 0 to 1.

        Args:
            views: the reference, then its neighbours; pictures [3, H, W], each side a multiple of 32 px.
            depths_m: [D] of the planes, increasing evenly, a multiple of 8 of them.
        """
        features = [self.feature(view.image[None])[0] for view in views]
        height, width = features[0].shape[1:]
        reduced = [_reduced(view, feature) for view, feature in zip(views, features, strict=True)]
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        rays = pixel_rays(rows, columns, reduced[0].K)
        inverse_depths = (1 / depths_m)[:, None, None].expand(-1, height, width)
        total = features[0][:, None].expand(-1, len(depths_m), -1, -1)  # [C, D, h, w]
        squares = total**2
        for other in reduced[1:]:
            terms = homography_terms(rays, reduced[0], other)
            warped = warp(other.image, *terms, inverse_depths)
            total, squares = total + warped, squares + warped**2
        variance = squares / len(views) - (total / len(views)) ** 2
        probability = self.cost_regularization(variance[None])[0, 0].softmax(dim=0)  # [D, h, w]
        depth_m = (probability * depths_m[:, None, None]).sum(dim=0)
        return depth_m, _mass_near(probability.detach())


def _reduced(view: View, feature: Tensor) -> View:
    """Return a view of the features [C, h, w], whose pixel i is centred on the picture's pixel 4 i."""
    K = view.K.clone()
    K[:2] /= STRIDE
    K[:2, 2] += 0.5 - 0.5 / STRIDE  # centres are at .5 in both
    lit = torch.zeros(feature.shape[1:], dtype=torch.bool)
    return View(feature, view.full_scale, lit, view.world_to_camera, K)


def _mass_near(probability: Tensor) -> Tensor:
    """Return the probability [h, w] of the four planes around the expected one, the paper's measure of confidence."""
    count = len(probability)
    expected = (probability * torch.arange(count)[:, None, None]).sum(dim=0).long()
    padded = F.pad(probability, (0, 0, 0, 0, 1, 2))
    four = sum(padded[k : k + count] for k in range(4))
    assert isinstance(four, Tensor)
    return four.gather(0, expected[None])[0]
