"""What a model is made of: Gaussians, cameras, rotations, spherical harmonics."""
