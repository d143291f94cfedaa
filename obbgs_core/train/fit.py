"""How well a training fits: running figures of its steps, and the model's own error on frames that it does not see."""

import logging
import math
from dataclasses import dataclass

import torch

from obbgs_core.losses import ON_TARGET_ALPHA, fit_figures
from obbgs_core.misfit import Compared, sampled, stated_misfit
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered, render
from obbgs_core.train.parts import Now, Seen
from obbgs_core.train.setup import TrainingSetup

MEMORY, CODED_EVERY = 0.98, 4  # what running figures keep in a step; of JPEG one step in so many is taken in
# share of the steps from which brackets that were kept back are trained on (docs/experiments/093)
UNSEEN_UNTIL = 0.6
log = logging.getLogger(__name__)


@dataclass
class Fit:
    """Running figures of the steps.

    chi2: running mean on the target, of the noise alone; NaN at first.
    psnr_db: of the last step's frames, full scale = 1.
    misfit: the model's own error as a share of the light, running mean; None: not learnt, or not yet.
    unseen_factor: how many times as large it is on frames that are not trained on; None: not measured.
    """

    chi2: float = math.nan
    psnr_db: float = math.nan
    misfit: float | None = None
    unseen_factor: float | None = None

    def observe(self, setup: TrainingSetup, rendered: Rendered, seen: Seen, step: int) -> None:
        """Take in a step, by sampled pixels; `rendered` is the whole model where the step left Gaussians out."""
        batch, each = seen.batch, 1 if setup.sensor.jpeg is None else CODED_EVERY
        if step % each:  # what is expected of JPEG takes as long as a step: one in so many stands for all
            return
        radiance, alpha, dn = sampled(setup.sensor, rendered.radiance, rendered.alpha, batch.dn)
        fit = fit_figures(radiance, alpha, batch.exposure_time_s, dn, setup.sensor, batch.averaged_pixels)
        self.psnr_db = fit.psnr_db
        if not math.isnan(fit.chi2):
            self.chi2 = fit.chi2 if math.isnan(self.chi2) else _running(self.chi2, fit.chi2, each)
        if setup.config.learns_misfit and not math.isnan(fit.misfit):
            self.misfit = _running(fit.misfit if self.misfit is None else self.misfit, fit.misfit, each)

    def due(self, now: Now) -> bool:
        """Return whether the brackets that are kept back are to tell the model's own error, and be trained on then.

        When growth has ended most details are found, and there is still time to learn what these brackets show.
        """
        return now.moment.share >= UNSEEN_UNTIL and now.keeps_unseen

    def decide(self, now: Now) -> None:
        """Learn how many times as large the model's own error is on brackets kept back, and train on them too."""
        self.unseen_factor = self.unseen(now.model, now.setup, now.order.validation_brackets)
        now.order.keep_back([])

    @torch.no_grad()
    def unseen(self, model: Gaussians, setup: TrainingSetup, brackets: list[list[int]]) -> float | None:
        """Return how many times as large the model's own error is on some brackets; None where they do not tell."""
        compared = []
        for bracket in brackets:
            batch = setup.batches.batch(bracket)
            rendered = render(model, batch.cameras)
            radiance, alpha, dn = sampled(setup.sensor, rendered.radiance, rendered.alpha, batch.dn)
            compared.append(Compared(radiance, alpha > ON_TARGET_ALPHA, batch.exposure_time_s, dn))
        misfit = stated_misfit(compared, setup.sensor)
        if not self.misfit or math.isnan(misfit):
            log.warning(
                "the brackets kept back do not tell the model's own error: that of the others is stated"
            )
            return None
        log.info("the model's own error is %.2f times as large on brackets kept back", misfit / self.misfit)
        return misfit / self.misfit


def _running(mean: float, value: float, steps: int) -> float:
    """Return a running mean after one more value, which stands for so many steps."""
    return MEMORY**steps * mean + (1 - MEMORY**steps) * value
