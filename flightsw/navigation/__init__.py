"""Where the camera is and how it points: orbit elements, states from the navigation filter, orbit messages."""
