"""What the command lines of flight, ground and simulator share: how they start, and how they end."""

import logging
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from obbgs_base.errors import Interrupted, ObbgsError, in_words
from obbgs_base.extras import how_to_install, installed_package
from obbgs_base.output import open_standard_streams, output_may_fail

# What several commands call by one name: the help of a name begins with the same words everywhere, up to a full stop,
# a semicolon or a colon; what follows is of the command.
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
CAMERA_HELP = (
    "The camera's URL, such as gige://ID (or its IP address), or with the scheme of an installed driver (none comes "
    "for V4L2), or simulated hil:///path/to/socket or hil://host:port"
)
BRACKET_HELP = "Exposure times in ms, such as 0.05,0.1,0.2"
START_HELP = "First trigger, UTC as 2026-07-21T10:52:30Z"
FRAMES_HELP = "Number of frames"
MISSION_HELP = "The mission file, the same in flight and on the ground"
LINK_HELP = "The link's URL, such as serial:///dev/ttyUSB0?baud=921600"
KEY_HELP = "The file of the mission's key"
SEED_HELP = "The same seed gives the same result"
PARTS = ("flightsw", "ground", "compare", "hil", "obbgs_core", "obbgs_base")
OUT_HELP = "What to write, a file or a folder"
USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[
    1
]  # of any wrong option; Typer shows only this one by name
SET_HELP = "A setting, NAME=VALUE; can be repeated, and a wrong name tells the nearest"


class _Group(TyperGroup):
    """A group of commands whose Ctrl-C is an error with a message, like any other; click would end in silence.

    What it says of a wrong value is in our words, not in those of the library that reads values for Typer.
    """

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            if isinstance(error.__cause__, ValueError):
                error.message = _refusal(error.message, error.__cause__)
            raise
        except KeyboardInterrupt as error:
            raise Interrupted(
                "interrupted; nothing is half written, the same command goes on where it can"
            ) from error


def _refusal(message: str, error: ValueError) -> str:
    """Return what was expected and what came, of "Input should be a valid integer, unable to" and such."""
    said, is_library, expected = message.partition("Input should be ")
    if said or not is_library:  # of our own choices
        return message.removeprefix("Value error, ")
    expected = expected.partition(", unable to")[0]
    given = getattr(error, "errors", lambda: [])()
    came = f", got {given[0]['input']!r}" if given else ""
    return f"expected {'' if expected.startswith('a ') else 'a number '}{expected}{came}"


def _show_version(wanted: bool) -> None:
    if wanted:
        print(*installed_package())
        raise typer.Exit


def new_app(summary: str) -> typer.Typer:
    """Return the command line of a tool, without commands yet; it knows --version and shell completion."""
    # as Markdown paragraphs are wrapped anew; otherwise they keep the line ends of the docstrings
    app = typer.Typer(cls=_Group, no_args_is_help=True, help=summary, rich_markup_mode="markdown")

    @app.callback(help=summary)
    def options(
        version: Annotated[
            bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
        ] = False,
    ) -> None:
        pass

    return app


def run(app: typer.Typer, tool: str) -> None:
    """Run a command line: one clear line for what went wrong, exit code 2 for usage and configuration, 1 for work.

    An error's message that cannot be written does not change its exit code.

    Args:
        tool: its name, also that of the package's extra which installs what it needs.
    """
    open_standard_streams()
    handler = _ToStderr()
    handler.setFormatter(_AsSaidBy(tool))
    handler.setLevel(logging.WARNING)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    try:
        sys.exit(app(standalone_mode=False) or 0)  # which leaves it to us to say what is wrong, without a box
    except USAGE_ERROR as error:
        _end(tool, _usage(error), 2)
    except ModuleNotFoundError as error:
        message = how_to_install(error, tool)
        if message is None:
            raise
        _end(tool, message, 2)
    except ObbgsError as error:
        _end(tool, str(error), error.exit_code)
    except ValueError as error:
        _end(tool, str(error), 2)
    except OSError as error:
        _end(tool, in_words(error), 1)


class _AsSaidBy(logging.Formatter):
    """Begins a message as those of errors do; the module's name stands in the logs of sessions and runs.

    Where a library of others says something, its name is told.
    """

    def __init__(self, tool: str):
        super().__init__("%(message)s")
        self._tool = tool

    def format(self, record: logging.LogRecord) -> str:
        of = "" if record.name.partition(".")[0] in PARTS else f" of {record.name}"
        return f"{self._tool}: {record.levelname.lower()}{of}: {super().format(record)}"


class _ToStderr(logging.StreamHandler):
    """Logs to what is stderr at the moment, as `output_may_fail` changes it."""

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)


def _usage(error: Any) -> str:
    """Return what is wrong with a command's words, in a line; nothing where the command's help was shown instead."""
    message = " ".join(error.format_message().split()).rstrip(".")
    where = "" if error.ctx is None else f" See `{error.ctx.command_path} --help`."
    return message and f"{message}.{where}"


def _end(tool: str, message: str, exit_code: int) -> None:
    if message:
        with output_may_fail():
            print(f"{tool}: {message}", file=sys.stderr)
    sys.exit(exit_code)
