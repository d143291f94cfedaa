"""What a training found of the errors of its poses: corrections with their prior and posterior deviations."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from obbgs_base.physics.navigation_errors import LENGTHS, SharedParameters

# a parameter whose posterior deviation is a larger share of the prior's is called unobservable
DETERMINED = 0.5


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The poses of the training's frames as tagged and as estimated, and the corrections in between.

    A correction is what makes a tagged pose the estimated one: first the shared parameters change, then each bracket's
    own motion follows, a rotation vector (rad), then a shift (m), along the camera's axes.
    """

    frame_ids: list[int]  # [F]
    brackets: list[int]  # [F] the row of each frame in the brackets' corrections
    tagged: np.ndarray  # [F, 4, 4] world_to_camera
    estimated: np.ndarray  # [F, 4, 4] world_to_camera
    shared: SharedParameters
    shared_prior: SharedParameters  # deviations; 0: not estimated
    shared_posterior: SharedParameters  # deviations
    shared_covariance: np.ndarray  # [19, 19] posterior
    own: np.ndarray  # [P, 6] of the brackets
    own_prior: np.ndarray  # [P, 6] deviations
    own_posterior: np.ndarray  # [P, 6] deviations

    def by_frame(self) -> dict[int, np.ndarray]:
        """Return the estimated pose [4, 4] of each frame of the training, by its number."""
        return dict(zip(self.frame_ids, self.estimated, strict=True))

    def of_frames(self, indices: list[int]) -> "PoseEstimate":
        """Return the estimate of some of its frames, by their place in it; the brackets stay all."""
        return dataclasses.replace(
            self,
            frame_ids=[self.frame_ids[i] for i in indices],
            brackets=[self.brackets[i] for i in indices],
            tagged=self.tagged[indices],
            estimated=self.estimated[indices],
        )

    def unobservable(self) -> list[str]:
        """Return the shared parameters of which the frames tell little, as `boresight_rad[2]`."""
        names = [f"{name}[{i}]" if size > 1 else name for name, size in LENGTHS.items() for i in range(size)]
        prior, posterior = self.shared_prior.vector(), self.shared_posterior.vector()
        return [n for n, a, b in zip(names, prior, posterior, strict=True) if a > 0 and b > DETERMINED * a]

    def tree(self) -> dict:
        """Return everything as lists and numbers, for JSON."""
        return {
            "shared": {
                name: {
                    "value": getattr(self.shared, name).tolist(),
                    "prior_sigma": getattr(self.shared_prior, name).tolist(),
                    "posterior_sigma": getattr(self.shared_posterior, name).tolist(),
                }
                for name in LENGTHS
            },
            "unobservable": self.unobservable(),
            "shared_covariance": self.shared_covariance.tolist(),
            "brackets": [
                {"motion": motion, "prior_sigma": prior, "posterior_sigma": posterior}
                for motion, prior, posterior in zip(
                    self.own.tolist(), self.own_prior.tolist(), self.own_posterior.tolist(), strict=True
                )
            ],
            "frames": [
                {"id": number, "bracket": bracket, "tagged": tagged, "estimated": estimated}
                for number, bracket, tagged, estimated in zip(
                    self.frame_ids, self.brackets, self.tagged.tolist(), self.estimated.tolist(), strict=True
                )
            ],
        }

    @staticmethod
    def of(tree: dict) -> "PoseEstimate":
        """Return the estimate that a `tree` holds.

        Raises:
            LookupError, TypeError, ValueError: it is no such tree.
        """
        value, prior, posterior = (
            SharedParameters(**{name: np.array(tree["shared"][name][key]) for name in LENGTHS})
            for key in ("value", "prior_sigma", "posterior_sigma")
        )
        own, own_prior, own_posterior = (
            np.array([bracket[key] for bracket in tree["brackets"]])
            for key in ("motion", "prior_sigma", "posterior_sigma")
        )
        frames = tree["frames"]
        return PoseEstimate(
            frame_ids=[frame["id"] for frame in frames],
            brackets=[frame["bracket"] for frame in frames],
            tagged=np.array([frame["tagged"] for frame in frames]),
            estimated=np.array([frame["estimated"] for frame in frames]),
            shared=value,
            shared_prior=prior,
            shared_posterior=posterior,
            shared_covariance=np.array(tree["shared_covariance"]),
            own=own,
            own_prior=own_prior,
            own_posterior=own_posterior,
        )
