"""Is a body as it was built: a model's surface against a mesh of its design, and lengths and areas of the surface."""
