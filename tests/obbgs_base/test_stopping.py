"""A command ends on SIGTERM whatever its main thread waits for, and whichever thread the kernel gives the signal."""

import signal
import subprocess
import sys
import threading
import time

from obbgs_base.stopping import StopRequest

MANY_SHORT_WAITS = """
import signal, time
from obbgs_base.stopping import stop_on_signals
stop = stop_on_signals()
print("ready", flush=True)
end_s = time.monotonic() + 2.0
while time.monotonic() < end_s:
    stop.wait(0.0)
    stop.clear()
signal.signal(signal.SIGTERM, signal.SIG_IGN)
"""
SIGNAL_TO_ANOTHER_THREAD = """
import signal, threading, time
from obbgs_base.stopping import join, stop_on_signals
stop = stop_on_signals()
def work():
    time.sleep(0.3)  # until the main thread waits
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
    while not stop.is_set():
        time.sleep(0.01)
thread = threading.Thread(target=work, daemon=True)
thread.start()
join(thread)
"""


def test_no_signal_hangs_a_wait():
    command = [sys.executable, "-c", MANY_SHORT_WAITS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == "ready\n"
        for _ in range(300):
            process.send_signal(signal.SIGTERM)
            time.sleep(0.005)
        try:
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()


def test_a_signal_that_another_thread_gets_ends_a_join():
    subprocess.run([sys.executable, "-c", SIGNAL_TO_ANOTHER_THREAD], check=True, timeout=60)


def test_a_wait_ends_in_its_time_or_when_asked():
    stop = StopRequest()
    assert not stop.wait(0.01) and not stop.is_set()
    threading.Timer(0.1, stop.set).start()
    assert stop.wait() and stop.is_set()
    stop.clear()
    assert not stop.wait(0.0)
