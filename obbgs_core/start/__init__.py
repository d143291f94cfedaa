"""The Gaussians that a training starts from: on the visual hull, or at random."""
