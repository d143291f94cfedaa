"""The ground station: receives frames into sessions, reconstructs models from them, scores and shows these."""
