"""The methods that ours is compared with and that are not trainings of Gaussians: NeRF, multi-view stereo, SfM."""
