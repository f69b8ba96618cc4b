"""The command line ``napari-mufasa`` (docs/files.md): parsing, progress, exit codes; the work is done elsewhere.

Exit 0 done · 2 bad input, one line that says what is wrong and what to do · 130 stopped with Ctrl-C · 1 a fault
of ours, one line that says so (``--debug`` shows where). Nothing heavy is imported until a verb runs.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from napari_mufasa.cli import notes

DONE, FAULT, BAD_INPUT, STOPPED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code (raises `SystemExit`)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    notes.begin()
    with warnings.catch_warnings(), _quiet("tifffile"), _quiet("matplotlib"):
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, category, *_, **__: notes.collect(message, category)
        code = _run(arguments, debug)
    if code in (DONE, STOPPED):  # what went wrong is told in one line
        notes.tell(notes.so_far())
    if code == STOPPED:
        _say(_stopped_line(arguments), STOPPED)
    raise SystemExit(code)


@contextlib.contextmanager
def _quiet(library: str) -> Iterator[None]:
    """What a library logs is for its developers; what is wrong is told by our own line."""
    logger, handler = logging.getLogger(library), logging.NullHandler()
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _run(arguments: list[str], debug: bool) -> int:
    import typer

    from napari_mufasa.cli.app import app, spread_lists
    from napari_mufasa.errors import Cancelled, MufasaError, system_line
    from napari_mufasa.provenance import command

    try:
        with command(arguments):
            result = app(spread_lists(arguments), prog_name="napari-mufasa", standalone_mode=False)
        sys.stdout.flush()
    except (typer.Abort, KeyboardInterrupt, Cancelled):
        return STOPPED
    except typer.Exit as leaving:  # typer's own for Ctrl-C, too
        return leaving.exit_code
    except MufasaError as error:
        return _say(str(error), BAD_INPUT, debug)
    except (BrokenPipeError, SystemExit):  # the reader of our output (head, less) has left; typer exits for that
        sys.stdout = None
        return DONE
    except Exception as error:
        if _is_usage_error(error):
            return _say(_usage_line(error), BAD_INPUT, debug)
        if isinstance(error, OSError):
            return _say(system_line(error), BAD_INPUT, debug)
        if isinstance(error, MemoryError):
            return _say("not enough memory: take fewer frames or a smaller field", BAD_INPUT, debug)
        where = "" if debug else "; please report this, with what --debug shows"
        return _say(f"unexpected {type(error).__name__}: {error}{where}", FAULT, debug)
    return result if isinstance(result, int) else DONE


def _stopped_line(arguments: Sequence[str]) -> str:
    if arguments[:1] == ["demo"]:
        return "stopped; the files that were finished stay: add --overwrite to begin again in the same folder"
    finished = "movies" if arguments[:1] == ["batch"] else "blocks"
    if finished == "movies" or "--resume" in arguments:
        return f"stopped; finished {finished} are kept, the same command goes on from them"
    return "stopped; nothing is half-written"


def _say(message: str, code: int, debug: bool = False) -> int:
    if debug:
        import traceback

        traceback.print_exc()
    print("napari-mufasa: " + notes.one_line(message), file=sys.stderr)
    return code


def _is_usage_error(error: Exception) -> bool:
    # typer brings its own copy of click in new versions, and uses the installed one in old ones.
    return any(kind.__name__ == "ClickException" for kind in type(error).__mro__)


def _usage_line(error: Any) -> str:
    context = getattr(error, "ctx", None)
    verb = context.command_path if context is not None else "napari-mufasa"
    message = str(error.format_message()).rstrip(".")
    return f"{message[:1].lower()}{message[1:]}; see '{verb} --help'"
