"""Stability conditions: what is changed about a session's training frames before a method sees them.

Held-out frames stay as they are, but for a held-out sector. Whatever is drawn at random is drawn from the frame's
number, so that every method and seed sees the same frames.
"""

import dataclasses
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy import ndimage

from compare.case import Case
from compare.errors import CompareError
from compare.sky_behind import behind
from flightsw.icd.config import MAX_YAML_BYTES, ConfigError, build, in_file, parse_yaml, require
from ground.run.settings import checked_settings
from obbgs_base.files import read_bounded
from obbgs_base.physics.stars import star_irradiance
from obbgs_core.frames import TrainingFrame
from obbgs_core.jpeg import JpegCoding
from obbgs_core.model.motions import rigid_motions
from obbgs_core.sensor import Sensor

# streams of random numbers, one a purpose
NOISE, SHUTTER, DARK, POSE, LOSS, STRAY, HOT, MOTION, SETTING = range(9)
BLUR_STEP_PX = 0.25  # between the shifted copies that are averaged
MOST_ELECTRONS = 1e15  # NumPy's Poisson refuses about 9e18
UNCERTAIN_SHIFT_M = 1e-6  # of a pose error that turns only: a covariance must not be singular


@dataclass(frozen=True)
class Condition:
    """One condition; the defaults leave the frames as they were taken.

    These expose the training frames anew, for which a session needs its truth:

    - exposure_ratios: the session's exposure times, shortest first, become its shortest times these.
    - noise: factor on the standard deviation of the noise.
    - exposure_error: standard deviation of ln(true / tagged exposure time), frame by frame.
    - setting_error: the same of each exposure time of the session, less the median of all, which is the unit of light.
    - exposure_drift: ln(true / tagged exposure time) grows by so much from the first frame to the last, around 0.
    - response_gamma: the readings follow signal ** gamma (full scale 1), while the method takes them for linear.
    - pedestal: share of full scale that is added to every reading before it is clipped, while no method is told of it.
    - earth: share of the frames that have the Earth or its limb behind the target, by day and from a height of 500 km,
      each at another place (`compare.sky_behind`); methods are told where the Earth is, as navigation would.
    - stars: a field of stars behind the target, where one of magnitude 6 reads so many deviations of the noise in the
      longest exposure; real ones are far fainter than that beside a target in sunlight.
    - blur_px: the camera turns evenly while the shutter is open, so that the picture moves by so many pixels in a
      direction at random; methods are told the rate.
    - stray_gradient: the same, from 0 at one corner of the picture to this share at another, in a direction at random.

    These need no truth:

    - believed_noise, believed_gain: factors on the noise, and on the signal per light, that the method is told.
    - synthetic_bracket: the frames in turn are exposed for these multiples of their own exposure time, their readings
      taken for the light without noise, as where photographs of one exposure are to stand for a bracket.
    - hot_pixels: share of the pixels, the same in all frames, that read up to full scale more than they should.
    - jpeg: the frames are stored as JPEG of this quality (1 to 100, as libjpeg counts it) and 8 bits; 0: they are not.
    - frames: how many of the training frames are left, evenly spaced; 0: all.
    - lost_percent: so many of the frames are lost at random.
    - missing_exposure: the frames of this exposure time are lost, 1 is the shortest; 0: none.
    - eclipse: the frames between these two shares of the session show only noise.
    - pose_error_deg: every pose is turned at random by this standard deviation about each axis, and tagged with it.
    - held_out_sector_deg: the frames of a sector of viewing directions so wide are held out, and they alone are scored.
    - set: settings of a training, such as `growth.interval: 60`; only methods that train Gaussians run under them.
    """

    exposure_ratios: tuple[float, ...] = ()
    noise: float = 1.0
    exposure_error: float = 0.0
    setting_error: float = 0.0
    exposure_drift: float = 0.0
    response_gamma: float = 1.0
    pedestal: float = 0.0
    stray_gradient: float = 0.0
    earth: float = 0.0
    stars: float = 0.0
    blur_px: float = 0.0
    synthetic_bracket: tuple[float, ...] = ()
    believed_noise: float = 1.0
    believed_gain: float = 1.0
    hot_pixels: float = 0.0
    jpeg: int = 0
    frames: int = 0
    lost_percent: float = 0.0
    missing_exposure: int = 0
    eclipse: tuple[float, ...] = ()
    pose_error_deg: float = 0.0
    held_out_sector_deg: float = 0.0
    set: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        for name in ("noise", "response_gamma", "believed_noise", "believed_gain"):
            require(getattr(self, name) > 0, name, f"expected more than 0, got {getattr(self, name):g}")
        for name in (
            "exposure_error",
            "setting_error",
            "stars",
            "blur_px",
            "frames",
            "missing_exposure",
            "pose_error_deg",
        ):
            require(getattr(self, name) >= 0, name, f"expected 0 or more, got {getattr(self, name):g}")
        for name in ("exposure_error", "setting_error", "exposure_drift"):
            error = abs(getattr(self, name))
            require(
                error <= MOST_EXPOSURE_ERROR, name, f"expected at most {MOST_EXPOSURE_ERROR:g}, got {error:g}"
            )
        for name in ("pedestal", "stray_gradient"):
            share = getattr(self, name)
            require(
                0 <= share < 1, name, f"expected a share of full scale from 0 to less than 1, got {share:g}"
            )
        require(
            0 <= self.earth <= 1, "earth", f"expected a share of the frames from 0 to 1, got {self.earth:g}"
        )
        require(
            0 <= self.hot_pixels < 1, "hot_pixels", f"expected a share of the pixels, got {self.hot_pixels:g}"
        )
        require(0 <= self.jpeg <= 100, "jpeg", f"expected a quality from 1 to 100, or 0, got {self.jpeg}")
        require(
            0 <= self.lost_percent < 100,
            "lost_percent",
            f"expected 0 to less than 100, got {self.lost_percent:g}",
        )
        require(
            0 <= self.held_out_sector_deg < 360,
            "held_out_sector_deg",
            f"expected 0 to less than 360, got {self.held_out_sector_deg:g}",
        )
        for name in ("exposure_ratios", "synthetic_bracket"):
            ratios = getattr(self, name)
            require(all(ratio > 0 for ratio in ratios), name, f"expected numbers above 0, got {list(ratios)}")
        require(
            not (self.synthetic_bracket and self.exposes_anew),
            "synthetic_bracket",
            "takes the readings for the light, the other conditions of exposure and noise the truth: leave one out",
        )
        whole = not self.eclipse or (len(self.eclipse) == 2 and 0 <= self.eclipse[0] < self.eclipse[1] <= 1)
        require(whole, "eclipse", f"expected two shares of the session in order, got {list(self.eclipse)}")

    @property
    def exposes_anew(self) -> bool:
        """Whether frames are made from the truth."""
        changed = (self.exposure_ratios, self.exposure_error, self.pedestal, self.stray_gradient)
        changed += (self.setting_error, self.exposure_drift, self.earth, self.stars, self.blur_px)
        return any(changed) or (self.noise, self.response_gamma) != (1, 1)

    def stated(self) -> dict[str, Any]:
        """Return what differs from the frames as they were taken, by name."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        default = Condition()
        return {name: value for name, value in fields.items() if value != getattr(default, name)}


MOST_EXPOSURE_ERROR = 3.0  # of ln(true / tagged exposure time): twenty times too long or short
AS_TAKEN = "as taken"  # the name of the condition that changes nothing


def load_conditions(path: Path) -> dict[str, Condition]:
    """Return the conditions of a YAML file, a mapping of names to conditions, in their order.

    Raises:
        CompareError: there is no such file.
        ConfigError: the file is not such a mapping, or two conditions are the same; names the file and the key.
        OSError: the file cannot be read.
    """
    if not path.is_file():
        raise CompareError(f"{path} is not there: --conditions takes a YAML file of names and conditions")
    with in_file(path):
        tree = parse_yaml(read_bounded(path, MAX_YAML_BYTES), "conditions")
        require(
            isinstance(tree, dict) and bool(tree), "conditions", "expected a mapping of names to conditions"
        )
        conditions: dict[str, Condition] = {}
        for name, content in tree.items():
            conditions[str(name)] = _condition(content or {}, f"conditions.{name}")
            for other in list(conditions)[:-1]:
                same = conditions[other].stated() == conditions[str(name)].stated()
                require(not same, f"conditions.{name}", f"is the same as {other}: leave one of them out")
    return conditions


def _condition(tree: Any, path: str) -> Condition:
    """Return a condition of a file, its settings checked and of the types that a training wants."""
    try:
        condition = build(Condition, tree, path)
    except ConfigError as error:  # the class names its fields without the place in the file
        raise ConfigError(
            error.path if error.path.startswith(path) else f"{path}.{error.path}", error.problem
        ) from error
    grouped: dict[str, Any] = {}
    for key, value in condition.set.items():
        group, dot, name = str(key).partition(".")
        if dot:
            grouped.setdefault(group, {})[name] = value
        else:
            grouped[group] = value
    return dataclasses.replace(condition, set=checked_settings(grouped, f"{path}.set"))


def given(case: Case, condition: Condition) -> tuple[list[TrainingFrame], Sensor]:
    """Return the training frames of a case under a condition, and the sensor that the method is told.

    Raises:
        CompareError: the condition does not fit the session.
    """
    frames = case.training
    if condition.exposes_anew:
        frames = _exposed_anew(case, condition)
    if condition.synthetic_bracket:
        frames = _bracketed(case, condition)
    if condition.eclipse:
        first, last = condition.eclipse
        frames = [
            _unlit(f, case.sensor, condition) if first <= i / len(frames) < last else f
            for i, f in enumerate(frames)
        ]
    if condition.hot_pixels:
        frames = _with_hot_pixels(frames, case.sensor, condition.hot_pixels)
    if condition.jpeg:
        frames = [_stored_as_jpeg(f, case.sensor, condition.jpeg) for f in frames]
    if condition.pose_error_deg:
        frames = [_turned(f, math.radians(condition.pose_error_deg)) for f in frames]
    frames = _left(frames, condition)
    sensor = dataclasses.replace(
        case.sensor,
        dn_per_radiance_s=case.sensor.dn_per_radiance_s * condition.believed_gain,
        electrons_per_dn=case.sensor.electrons_per_dn / condition.believed_noise**2,
        read_noise_dn=case.sensor.read_noise_dn * condition.believed_noise,
        jpeg=_coding(frames[0], condition.jpeg) if condition.jpeg else None,
    )
    return frames, sensor


def _exposed_anew(case: Case, condition: Condition) -> list[TrainingFrame]:
    """Return the training frames with the exposure times, the noise and the response of a condition."""
    times_s = sorted({frame.exposure_time_s for frame in case.training})
    ratios = condition.exposure_ratios
    if ratios and len(ratios) != len(times_s):
        raise CompareError(
            f"{case.name} has {len(times_s)} exposure times, but exposure_ratios names {len(ratios)}: give one for each"
        )
    tagged_s = (
        {old_s: times_s[0] * ratio for old_s, ratio in zip(times_s, ratios, strict=True)} if ratios else {}
    )
    view, frames = case.true_views(), []
    star_gain = _star_gain(case.sensor, condition, max(times_s))
    drawn = np.random.default_rng(SETTING).standard_normal(len(times_s))
    of_setting = dict(zip(times_s, condition.setting_error * (drawn - np.median(drawn)), strict=True))
    along = np.linspace(-0.5, 0.5, len(case.training))
    for number, frame in enumerate(case.training):
        exposure_s = tagged_s.get(frame.exposure_time_s, frame.exposure_time_s)
        longer = math.exp(
            _random(SHUTTER, frame).normal(0, condition.exposure_error)
            + of_setting[frame.exposure_time_s]
            + condition.exposure_drift * along[number]
        )
        light, coverage, finer = view(frame)
        scene = behind(frame, condition.earth, star_gain)
        beside = (1 - coverage[..., None]) * scene.radiance
        if condition.blur_px:
            light, beside = (
                _blurred(of.astype(float), frame, condition.blur_px)
                for of in (light if finer is None else finer, beside)
            )
        light = light.astype(float) + beside
        rates = _rates(frame, exposure_s, condition.blur_px)
        added_dn = _added_dn(frame, case.sensor, condition)
        dn = read_out(light, exposure_s * longer, case.sensor, condition, _random(NOISE, frame), added_dn)
        dn = torch.from_numpy(dn.astype(np.float32))
        frames.append(
            dataclasses.replace(frame, dn=dn, exposure_time_s=exposure_s, earth_m=scene.earth_m, rates=rates)
        )
    return frames


def _moved_px(frame: TrainingFrame, blur_px: float) -> tuple[float, float]:
    """Return by how much a picture moves along x and y while the shutter is open, px, in a direction at random."""
    angle = _random(MOTION, frame).uniform(0, 2 * math.pi)
    return blur_px * math.cos(angle), blur_px * math.sin(angle)


def _rates(frame: TrainingFrame, exposure_s: float, blur_px: float) -> torch.Tensor | None:
    """Return the target's rates as in `TrainingFrame`; None where it stands still."""
    if not blur_px:
        return None
    x, y = _moved_px(frame, blur_px)
    return torch.tensor([-y / frame.K[1, 1], x / frame.K[0, 0], 0, 0, 0, 0]) / exposure_s


def _blurred(light: np.ndarray, frame: TrainingFrame, blur_px: float) -> np.ndarray:
    """Return light [nH, nW, C] as a camera sees it [H, W, C] that turns evenly.

    Between pixels it is interpolated, which is exact to 50 dB of the peak where n is 1, as a sharp edge in between is
    not known.
    """
    height, width, channels = frame.shape
    n = light.shape[0] // height
    x, y = (n * way for way in _moved_px(frame, blur_px))
    copies = math.ceil(blur_px / BLUR_STEP_PX)
    shares = (np.arange(copies) + 0.5) / copies - 0.5
    moved = np.stack(
        [_mean_of_shifts(light[..., k], shares * y, shares * x) for k in range(channels)], axis=2
    )
    return moved.reshape(height, n, width, n, channels).mean(axis=(1, 3)).clip(min=0)


def _mean_of_shifts(light: np.ndarray, down_px: np.ndarray, right_px: np.ndarray) -> np.ndarray:
    """Return the mean of copies of light [H, W] that are shifted so, by cubic splines that are found once."""
    splines = ndimage.spline_filter(light, order=3, mode="mirror")
    moves = zip(down_px, right_px, strict=True)
    return np.mean([ndimage.shift(splines, move, order=3, prefilter=False) for move in moves], axis=0)


def _star_gain(sensor: Sensor, condition: Condition, longest_s: float) -> float:
    """Return how many times brighter the stars are than real ones, for one of magnitude 6 to read as a condition says.

    Times the solid angle of a pixel, which `behind` divides by.
    """
    wanted = condition.stars * sensor.read_noise_dn / (sensor.dn_per_radiance_s * longest_s)
    return wanted / star_irradiance(6.0)


def _bracketed(case: Case, condition: Condition) -> list[TrainingFrame]:
    """Return the training frames with the exposure times of a synthetic bracket, one a frame in turn, and new noise."""
    if case.session is not None and case.session.encoding != "linear":
        raise CompareError(
            f"the values of {case.name} are {case.session.encoding}-coded, and a synthetic bracket needs values that "
            "are linear in light: import the pictures with --values decode"
        )
    sensor, ratios, frames = case.sensor, condition.synthetic_bracket, []
    for i, frame in enumerate(case.training):
        light = (frame.dn.double() - sensor.black_dn) / (sensor.dn_per_radiance_s * frame.exposure_time_s)
        exposure_s = frame.exposure_time_s * ratios[i % len(ratios)]
        dn = read_out(light.numpy(), exposure_s, sensor, condition, _random(NOISE, frame))
        frames.append(
            dataclasses.replace(frame, dn=torch.from_numpy(dn.astype(np.float32)), exposure_time_s=exposure_s)
        )
    return frames


def _added_dn(frame: TrainingFrame, sensor: Sensor, condition: Condition) -> np.ndarray:
    """Return what a condition adds to the readings [H, W, 1] of a frame, DN."""
    height, width = frame.dn.shape[:2]
    angle = _random(STRAY, frame).uniform(0, 2 * math.pi)
    y, x = ((np.arange(n) + 0.5) / n for n in (height, width))
    along = math.cos(angle) * x[None] + math.sin(angle) * y[:, None]
    along = (along - along.min()) / np.ptp(along)
    share = condition.pedestal + condition.stray_gradient * along
    return share[..., None] * (sensor.white_dn - sensor.black_dn)


def read_out(
    radiance: np.ndarray,
    exposure_s: float,
    sensor: Sensor,
    condition: Condition,
    rng: np.random.Generator,
    added_dn: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the readings (DN) of a radiance: shot and read noise times the condition's factor, rounded, then clipped.

    The response bends the signal before the noise: signal ** response_gamma, full scale as 1.

    Args:
        added_dn: [H, W, 1] what is added to the signal, without shot noise.
    """
    range_dn = sensor.white_dn - sensor.black_dn
    signal_dn = sensor.dn_per_radiance_s * exposure_s * radiance.clip(min=0)
    signal_dn = range_dn * (signal_dn / range_dn) ** condition.response_gamma
    mean_e = np.minimum(signal_dn * sensor.electrons_per_dn, MOST_ELECTRONS)
    shot_dn = (rng.poisson(mean_e) - mean_e) / sensor.electrons_per_dn
    noise_dn = shot_dn + sensor.read_noise_dn * rng.standard_normal(radiance.shape)
    return np.rint(sensor.black_dn + added_dn + signal_dn + condition.noise * noise_dn).clip(
        0, sensor.white_dn
    )


def _unlit(frame: TrainingFrame, sensor: Sensor, condition: Condition) -> TrainingFrame:
    """Return a frame of the same camera that shows no light, only noise."""
    nothing, added_dn = np.zeros(tuple(frame.dn.shape)), _added_dn(frame, sensor, condition)
    dark = read_out(nothing, frame.exposure_time_s, sensor, condition, _random(DARK, frame), added_dn)
    return dataclasses.replace(frame, dn=torch.from_numpy(dark.astype(np.float32)))


def _with_hot_pixels(frames: list[TrainingFrame], sensor: Sensor, share: float) -> list[TrainingFrame]:
    """Return frames of one size in which the same pixels read more, by as much as each of them does in all frames."""
    rng, (height, width) = np.random.default_rng(HOT), frames[0].dn.shape[:2]
    more_dn = rng.uniform(0, sensor.white_dn, (height, width, 1)) * (rng.random((height, width, 1)) < share)
    added_dn = torch.from_numpy(np.rint(more_dn).astype(np.float32))
    return [dataclasses.replace(f, dn=(f.dn + added_dn).clamp(max=sensor.white_dn)) for f in frames]


def _stored_as_jpeg(frame: TrainingFrame, sensor: Sensor, quality: int) -> TrainingFrame:
    """Return a frame as it comes back from a JPEG file, whose 255 is the sensor's full scale."""
    scale_dn = sensor.white_dn / 255
    values = (frame.dn / scale_dn).round().to(torch.uint8).numpy()
    stored, _ = _through_jpeg(values, quality)
    return dataclasses.replace(frame, dn=torch.from_numpy(stored.astype(np.float32) * scale_dn))


def _coding(frame: TrainingFrame, quality: int) -> JpegCoding | None:
    """Return how frames are coded as JPEG of a quality."""
    return _through_jpeg(np.zeros(tuple(frame.dn.shape), np.uint8), quality)[1]


def _through_jpeg(values: np.ndarray, quality: int) -> tuple[np.ndarray, JpegCoding | None]:
    """Return what comes back of values [H, W, C], uint8, and how they were coded."""
    file = io.BytesIO()
    Image.fromarray(values[..., 0] if values.shape[2] == 1 else values).save(file, "JPEG", quality=quality)
    with Image.open(file) as stored:
        return np.asarray(stored).reshape(values.shape), JpegCoding.of(stored)


def _turned(frame: TrainingFrame, sigma_rad: float) -> TrainingFrame:
    """Return a frame with its camera turned at random about its own axes, and tagged as that uncertain."""
    sigma = torch.tensor([sigma_rad] * 3 + [UNCERTAIN_SHIFT_M] * 3, dtype=torch.float64)
    drawn = torch.from_numpy(_random(POSE, frame).standard_normal(6)) * sigma
    pose = rigid_motions(drawn[None].float())[0] @ frame.world_to_camera
    return dataclasses.replace(frame, world_to_camera=pose, pose_covariance=torch.diag(sigma**2))


def _left(frames: list[TrainingFrame], condition: Condition) -> list[TrainingFrame]:
    """Return the frames that are not lost."""
    if condition.missing_exposure:
        times_s = sorted({frame.exposure_time_s for frame in frames})
        if condition.missing_exposure > len(times_s):
            raise CompareError(
                f"missing_exposure is {condition.missing_exposure}, but there are only {len(times_s)} exposure times"
            )
        frames = [f for f in frames if f.exposure_time_s != times_s[condition.missing_exposure - 1]]
    if condition.frames:
        if condition.frames > len(frames):
            raise CompareError(f"{condition.frames} frames are asked for, only {len(frames)} are there")
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, condition.frames).round().astype(int)]
    if condition.lost_percent:
        order = np.random.default_rng(LOSS).permutation(len(frames))
        lost = set(order[: int(len(frames) * condition.lost_percent / 100)].tolist())
        frames = [frame for i, frame in enumerate(frames) if i not in lost]
    if not frames:
        raise CompareError("the condition leaves no training frame")
    return frames


def _random(stream: int, frame: TrainingFrame) -> np.random.Generator:
    """Return the random numbers of a frame for one purpose."""
    return np.random.default_rng((stream, frame.id))
