"""The command of `ground` that sends commands to the spacecraft, one or a script of them."""

import itertools
import json
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from flightsw.icd.config import ConfigError
from flightsw.icd.mission import load_mission
from ground.commands.options import UplinkCommand, listening_key
from obbgs_base.command_line import KEY_HELP, LINK_HELP, MISSION_HELP, USAGE_ERROR, AsJson
from obbgs_base.errors import reason
from obbgs_base.output import output_may_fail

if TYPE_CHECKING:
    from flightsw.icd.command import Command

LOOK_S = 0.5  # between looks whether somebody listens
RESTART_S = 5.0  # that a listener may be gone: it may be starting again
NEGATIVE = re.compile(r"-[\d.]")  # how a negative number begins


class UplinkWords(TyperCommand):
    """The words after `ground uplink`: a negative number among them is no option, but an argument out of range."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        from ground.link.uplink import parse_command

        given = list(args)  # parsing takes them away
        try:
            return super().parse_args(ctx, args)
        except USAGE_ERROR as error:
            if not NEGATIVE.match(getattr(error, "option_name", "")):
                raise
            names = [each.value for each in UplinkCommand]
            start = next((place for place, word in enumerate(given) if word in names), len(given))
            words = list(itertools.takewhile(lambda word: not word.startswith("--"), given[start:]))
            if words:
                parse_command(words[0], words[1:])  # says what is expected
            raise


@output_may_fail()
def uplink_command(
    command: Annotated[
        UplinkCommand | None, typer.Argument(help="The command; none with --script.", show_default=False)
    ] = None,
    arguments: Annotated[list[str] | None, typer.Argument(help="Its arguments, as above.")] = None,
    session: Annotated[Path, typer.Option("--session", help="The session folder.")] = Path("session"),
    key_file: Annotated[Path, typer.Option("--key", help=f"{KEY_HELP}.")] = Path("mission.key"),
    link: Annotated[
        str | None, typer.Option(help=f"{LINK_HELP}; default: `ground listen` of the session has it open.")
    ] = None,
    mission: Annotated[Path, typer.Option(help=f"{MISSION_HELP}; read with --link only.")] = Path(
        "mission.yaml"
    ),
    timeout: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=86_400.0,
            help="Seconds to wait for each result, or for a model to be under way.",
        ),
    ] = 120.0,
    script: Annotated[
        Path | None,
        typer.Option(
            help="A file of commands, one a line, # before remarks: sent one after another, up to the first that is "
            "not completed."
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Send a command through the session's `ground listen`, or over --link, and wait for its result.

    ping · bracket 0.05,0.1,0.2 (exposure times, ms) · near 2 (largest coding error, DN) · priority oldest, triage or
    thumbnail-first · model FILE (a run's model.onnx) · safe (no more exposures) · resend FIRST LAST or all (frames that
    are still on board, delivered once more) · fsck (check and repair the frame store while flight goes on). `arm
    delete` and then delete FIRST LAST (numbers of frames), `arm resume` and then resume, `arm retire` and then retire
    KEY (the number of another key), each at most 30 s later. What became of all commands of a session stands in its
    commands.jsonl.

    Example: ground uplink bracket 0.02,0.05,0.1 --session pass-12 --key mission.key
    """
    from ground.link import uplink as uplinking
    from ground.session.folder import SessionError

    if (command is None) == (script is None):
        raise ValueError(
            "expected one command, such as `ground uplink ping`, or a file of them after --script"
        )
    if command is not None:
        made = [uplinking.parse_command(command.value, arguments or [])]
    else:
        made = uplinking.parse_script(_text_of(script))
    for _, model in made:
        if model is not None:
            uplinking.check_model(model)
    if link is None and not uplinking.is_listening(session):
        raise SessionError(f"no `ground listen` receives into {session}: start one, or give --link URL")
    for place, (each, model) in enumerate(made, start=1):
        words = uplinking.in_words(each, model)
        result = _sent(session, key_file, each, model, link, mission, timeout)
        if json_:
            print(json.dumps(result), flush=True)
        else:
            before = f"{words}: " if script is not None else ""
            reports = result["reports"]
            ended = reports and reports[-1]["stage"] == result["stage"]
            for report in reports if ended else [*reports, result]:
                print(f"{before}{report['stage']}: {report['text']}", flush=True)
        if result["stage"] != "completed":
            if not json_ and place < len(made):
                print(f"the script ends here; not sent: {len(made) - place} more")
            raise typer.Exit(1)


def _text_of(script: Path | None) -> str:
    from ground.session.folder import SessionError

    assert script is not None
    try:
        return script.read_text()
    except OSError as error:
        raise SessionError(f"the script {script} cannot be read: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(script), "is no text; a script has a command on each line") from error


def _sent(
    session: Path,
    key_file: Path,
    command: "Command",
    model: Path | None,
    link: str | None,
    mission: Path,
    timeout_s: float,
) -> dict[str, Any]:
    """Leave a command for the listener, or send it over a link; wait for its end and return it."""
    from ground.link import uplink as uplinking

    counter = uplinking.submit(session, key_file, command, model, timeout_s)
    end_s = time.monotonic() + timeout_s + 1.0  # the listener writes a result when the command expires

    def ended() -> bool:
        if uplinking.outcome(session, counter) is not None:
            return True
        if time.monotonic() <= end_s:
            return False
        return model is None or not uplinking.is_waiting(session, counter)

    try:
        if link is None:
            heard_s = looked_s = time.monotonic()
            while not ended() and looked_s - heard_s <= RESTART_S:
                if time.monotonic() - looked_s > LOOK_S:
                    looked_s = time.monotonic()
                    heard_s = looked_s if uplinking.is_listening(session) else heard_s
                time.sleep(0.05)
        else:
            from ground.link.ingest import listen

            listen(link, session, load_mission(mission), should_stop=ended, key=listening_key(key_file))
    finally:
        was_sent = uplinking.was_sent(session, counter)
        uplinking.withdraw(session, counter)
    result = uplinking.outcome(session, counter)
    if result is None:
        words = uplinking.in_words(command, model)
        result = {"counter": counter, "command": command.name, "given": words, "stage": "failed"}
        text = (
            "it was sent, no answer came, and it may have been executed" if was_sent else "no process sent it"
        )
        if link is None and not uplinking.is_listening(session):
            then = "a `ping` before it is repeated" if was_sent else "the command"
            text = f"`ground listen` of {session} has ended: {text}; start it again, and give {then}"
        result |= {"text": text, "reports": []}
        uplinking.note_end(session, result, time.time_ns())
    return result
