"""Simulated links with faults: a serial line, and a CAN bus with slcan adapters."""
