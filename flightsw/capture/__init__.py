"""Which frames are taken and when: brackets, exposure times, the region to read, the plan of a pass."""
