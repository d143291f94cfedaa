"""Links over a serial port."""

import errno
import os
import select
import termios

import serial

from flightsw.ports.port import Port
from obbgs_base.errors import reason

READ_BYTES = 65_536
END_OTHER = "end that one, which `fuser` with the port's name tells"
REMEDIES = {  # of errors when a port is opened
    errno.ENOENT: "plug the adapter in, or give the name that `ls /dev/tty*` shows with it",
    errno.EACCES: "let this user use it: `sudo usermod -aG dialout $USER`, then log in again",
    errno.EBUSY: END_OTHER,
    errno.EAGAIN: END_OTHER,
    errno.ENOTTY: "give a serial port, such as /dev/ttyUSB0",
}


class SerialLink(Port):
    """A serial port."""

    OPEN_ERRORS = (*Port.OPEN_ERRORS, termios.error)  # which is no OSError

    _port: serial.Serial | None = None
    _unsent = b""

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    @property
    def connected(self) -> bool:
        return self._port is not None

    @property
    def ready(self) -> bool:
        return self._port is not None and not self._unsent

    @property
    def losses(self) -> dict[str, int]:
        return {}

    def write(self, data: bytes) -> None:
        self._unsent += data
        self._flush()

    def exchange(self, timeout_s: float) -> bytes:
        if not self._wait_for_port(timeout_s):
            return b""
        assert self._port is not None
        try:
            descriptor = self._port.fileno()
            writers = [descriptor] if self._unsent else []
            readable, writable, _ = select.select([descriptor], writers, [], timeout_s)
            if writable:
                self._flush()
            if not readable or self._port is None:
                return b""
            data = os.read(descriptor, READ_BYTES)
            if not data:
                raise OSError("the device went away")
        except self.OPEN_ERRORS as error:
            self._hang_up(error)
            return b""
        self.bytes_read += len(data)
        return data

    def _flush(self) -> None:
        if self._port is None or not self._unsent:
            return
        try:
            count = os.write(self._port.fileno(), self._unsent)
        except BlockingIOError:
            return
        except (OSError, ValueError) as error:
            self._hang_up(error)
            return
        self.bytes_written += count
        self._unsent = self._unsent[count:]

    def _open(self) -> None:
        self._port = serial.Serial(
            self.url.device, self.url.baud_rate, timeout=0, write_timeout=0, exclusive=True
        )
        self._unsent = b"\0"  # ends whatever half packet the other side still holds

    def _why(self, error: Exception) -> tuple[str, str]:
        met = [each.args[0] for each in (error, error.__context__) if each is not None and each.args]
        remedy = next((REMEDIES[number] for number in met if number in REMEDIES), "")
        return ("another program holds it" if remedy == END_OTHER else reason(error)), remedy

    def _drop(self) -> None:
        self._unsent = b""
        SerialLink.close(self)
