"""A closed, textured mesh of what a model shows: flat faces flat, plates thin, few triangles."""
