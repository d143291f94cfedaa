"""The choice of the model by evidence: pruning by BIC, the degree of the harmonics, and highlights."""

import dataclasses
import logging
from dataclasses import dataclass
from typing import Literal

from obbgs_core.evidence.gains import justified
from obbgs_core.evidence.highlights import along_normals, lobed
from obbgs_core.evidence.radiance import described, raised_degree
from obbgs_core.methods.config import SET_BACK_AT
from obbgs_core.train.parts import Change, Now

log = logging.getLogger(__name__)
SUN_FROM = 0.05  # share of the steps at which a moving Sun is first tested, before any growth
# share of the steps at which highlights are tested; later they gain less (experiment 069)
HIGHLIGHTS_FROM = 0.1
# before that a model has not settled, and parallax that it does not have yet looks like highlights
FEWEST_STEPS = 100
MORE_FRAMES = 1.5  # times as many as at the last test: then they are tested again


class Pruning:
    """Removes the Gaussians whose likelihood gain is below their BIC penalty."""

    def due(self, now: Now) -> bool:
        """Return whether it is one of the times for it."""
        return any(now.is_step(share) for share in now.config.parsimony.prune_at)

    def decide(self, now: Now) -> Change | None:
        """Return the model without them; None if they were all."""
        setup, least = now.setup, now.config.parsimony.keep_above_opacity
        kept = justified(now.model, now.batches, setup.sensor, setup.radius_m, least, now.rng)
        if not kept.any():
            return None
        removed = len(kept) - int(kept.sum())
        return Change.only(now.gaussians, kept, f"{removed} Gaussians are pruned by BIC")


@dataclass
class Harmonics:
    """Lets the radiance turn with view or Sun, or raises its degree, where the gain exceeds the BIC penalty.

    reason: why the radiance depends on what it does, in words.
    """

    reason: str = ""

    def due(self, now: Now) -> bool:
        """Return whether it is one of the times for it: those of pruning, and an early one for a Sun that moves."""
        return bool(self._directions(now))

    @staticmethod
    def _directions(now: Now) -> tuple[Literal["view", "sun"], ...]:
        """Return what is tested; a moving Sun before the view."""
        if any(now.is_step(share) for share in now.config.parsimony.prune_at):
            return ("sun", "view") if now.setup.sun_moves else ("view",)
        return ("sun",) if now.setup.sun_moves and now.is_step(SUN_FROM) else ()

    def decide(self, now: Now) -> Change | None:
        """Return the model with another dependence; None if that is not justified."""
        setup, light = now.setup, now.config.light
        given = (now.gaussians, now.batches, setup.sensor, self._directions(now), light.max_sh_degree)
        raised, tested = raised_degree(*given, light.sun_shading == "linear", setup.albedos_turn, now.rng)
        if tested:
            self.reason = f"step {now.moment.done + 1}, {tested}"
            log.info("radiance %s", described(raised or now.gaussians, self.reason))
        return None if raised is None else Change(raised, None)


@dataclass
class Highlights:
    """Gives every Gaussian a highlight, if frames that are withheld from the choice are explained better by them.

    Where none were found they are tested again once half as many frames again have joined; where poses are refined they
    are only tested once the poses have settled again. Where the Sun moves they are given in any case: along their
    normals if withheld brackets are not explained better.

    reason: why the radiance has them or not, in words; nothing: not tested.
    frames: how many there were when they were tested.
    """

    reason: str = ""
    frames: int = 0

    def due(self, now: Now) -> bool:
        """Return whether it is time to test them, and they are not there yet."""
        begin = round(now.config.steps_until(SET_BACK_AT if now.is_resettling else HIGHLIGHTS_FROM))
        is_time = now.moment.done + 1 >= begin >= FEWEST_STEPS and not now.waits_for_poses
        untested = len(now.setup.frames) >= MORE_FRAMES * self.frames
        return is_time and untested and now.config.light.highlights and not now.gaussians.has_highlights

    def decide(self, now: Now) -> Change | None:
        """Return the model with highlights; None if they are not justified."""
        found = lobed(now.model, now.batches, now.setup.sensor, now.misfit, now.shadows, now.moment.done)
        shiny, along = found.gaussians, ""
        if shiny is None and now.gaussians.shading != "view":
            shiny, along = along_normals(now.gaussians), "; so they lie along the normals"
        self.frames, self.reason = len(now.setup.frames), f"step {now.moment.done + 1}, {found}{along}"
        if shiny is None:
            log.info("radiance %s", described(now.gaussians, self.reason))
            return None
        changed = {name: getattr(shiny, name) for name in ("sh", "lobes", "gloss", "static_sun")}
        model = dataclasses.replace(now.gaussians, **changed)
        log.info("radiance %s", described(model, self.reason))
        return Change(model, None)
