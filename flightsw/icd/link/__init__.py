"""How packets become bytes of a serial line or CAN frames, where a link is, and how commands are authenticated."""
