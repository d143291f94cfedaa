"""Pictures of other tools and data sets: their files, lenses, masks and lights, and how they become a session."""
