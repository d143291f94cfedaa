"""The simulator: the world around flight and ground, the camera and the link between them.

Rooms: `world` (orbits, attitude, scenarios, navigation states, clock), `sky` (light: Blender, sensor, motion, stars,
the shipped spacecraft), `links` (serial line and CAN bus with faults), `cameras` (servers of the simulated camera).
`world` and `sky` import no other room, `links` only `watched`, `cameras` imports `world`, `sky` and `watched`.
What stands beside the rooms puts them together: `truth` (from `sky`), `simulated_pass`, `demo`, `dataset`, `cli`;
no room imports those. A test holds these arrows.
"""
