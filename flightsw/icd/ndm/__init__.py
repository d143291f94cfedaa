"""Navigation data messages of CCSDS (NDM): orbits and attitudes as other software writes and reads them.

`Formation` reads the messages of target and chaser, `write_oem` and `write_aem` write them. A small strict reader of
its own keeps flight light; other implementations are the oracle of its tests.
"""
