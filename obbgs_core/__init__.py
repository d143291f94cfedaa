"""The library: exposure brackets of known poses in, a 3D Gaussian model out.

>>> import torch
>>> from obbgs_core import Cameras, Gaussians, Sensor, TrainingFrame, preset, psnr_db
>>> from obbgs_core.render import render
>>> from obbgs_core.train import train
>>> sensor = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=2.0, read_noise_dn=3.0)
>>> truth = Gaussians(torch.zeros(1, 3), torch.ones(1, 4), torch.full((1, 3), -1.5), torch.ones(1), torch.ones(1, 1, 1))
>>> pose, K = torch.eye(4), torch.tensor([[60.0, 0, 16], [0, 60, 16], [0, 0, 1]])
>>> pose[2, 3] = 4.0  # metres from the camera to the origin, along its axis
>>> seen = render(truth, Cameras(pose[None], K[None], width=32, height=32)).radiance[0]
>>> frames = [TrainingFrame(sensor.expected_dn(seen, t), t, pose, K) for t in (5e-5, 1e-4, 2e-4)]
>>> result = train(frames, sensor, preset("obbgs", {"steps": 20, "start.count": 100}))
>>> again = render(result.gaussians, Cameras(pose[None], K[None], width=32, height=32)).radiance[0]
>>> len(result.history), bool(psnr_db(again, seen) > 20)
(20, True)

The names in `__all__` can be imported from `obbgs_core`; the function `render` comes from `obbgs_core.render` and
`train` from `obbgs_core.train`. Each module is imported when one of its names is first used, since PyTorch takes
seconds to load.
"""

from obbgs_base.imports import lazily

_MODULES = {  # public name: the module that defines it
    "Cameras": "model.cameras",
    "Gaussians": "model.gaussians",
    "MethodConfig": "methods.config",
    "PRESETS": "methods.presets",
    "ReconstructionError": "errors",
    "Sensor": "sensor",
    "StepInfo": "train.result",
    "TrainResult": "train.result",
    "TrainingFrame": "frames",
    "cloud_distances": "score.metrics",
    "export_onnx": "io.onnx",
    "load_ply": "io.ply",
    "preset": "methods.presets",
    "psnr_db": "score.metrics",
    "save_ply": "io.ply",
    "ssim": "score.metrics",
    "surface_points": "score.surface",
}
__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = lazily(__name__, _MODULES)
