"""The process that reads spoilt files: little memory, little time, and a line for every case before it begins."""

import argparse
import faulthandler
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from types import FrameType

from damage import damaged
from formats import FORMATS, Format

from epipole.errors import EpipoleError

MORE_BYTES = 1 << 30
"""What a reader may take beyond the process as it stands."""
SECONDS = 10
"""Of the processor."""
LONGEST_MESSAGE = 8192


_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


class TooLong(BaseException):
    """A reader has used up its time."""


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooLong


def _virtual_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _resident_kib(what: str) -> int:
    return int(_STATUS.read_text().split(what + ":")[1].split()[0])


def _causes(error: BaseException | None) -> list[BaseException]:
    return [error, *_causes(error.__cause__ or error.__context__)] if error is not None else []


def outcome(form: Format, folder: Path) -> str | None:
    """What is wrong with how a file is read; None where every way ends in a clear error or a sound object."""
    return next(filter(None, (_outcome(form, read, folder) for read in (form.read, *form.also))), None)


def _outcome(form: Format, read: Callable[[Path], None], folder: Path) -> str | None:
    before = _resident_kib("VmRSS")
    _CLEAR.write_text("5")  # the peak begins anew
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        read(folder)
        said = None
    except EpipoleError as error:
        message = str(error)
        text = "".join(f"{type(e).__name__}: {e}" for e in _causes(error))
        if (
            ("MemoryError" in text and not form.may_ask)
            or "Insufficient memory" in text
            or "OutOfMemory" in text
        ):
            said = f"the memory ran out: {text[:500]}"
        elif len(message) > LONGEST_MESSAGE:
            said = f"a message of {len(message)} letters"
        elif form.must_name and folder.name not in message:
            said = f"the message names no file: {message[:300]}"
        else:
            message.encode()
            said = None
    except TooLong:
        said = f"more than {SECONDS} s: " + traceback.format_exc(limit=-4)
    except Exception:  # noqa: BLE001 - whatever comes is what is looked for
        said = traceback.format_exc(limit=-5)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    grown = _resident_kib("VmHWM") - before
    return said or (f"took {grown >> 10} MB" if grown > form.most_mib << 10 else None)


class Bench:
    """Valid examples, each in a folder of its own."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.files: dict[str, dict[str, bytes]] = {}

    def prepare(self, name: str) -> None:
        """Write the valid example and read it, which also warms up what is compiled or loaded late."""
        folder = self.root / name
        folder.mkdir(parents=True)
        FORMATS[name].write(folder)
        self.files[name] = {
            str(path.relative_to(folder)): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        with suppress(*([EpipoleError] if FORMATS[name].may_be_refused else [])):
            FORMATS[name].read(folder)

    def spoil(self, name: str, seed: int, case: int) -> Path:
        """The folder of the example with one file spoilt; the same numbers give the same bytes."""
        form, folder = FORMATS[name], self.root / name
        shutil.rmtree(folder, ignore_errors=True)
        rng = Random(f"{name}/{seed}/{case}")
        for file, data in self.files[name].items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(damaged(rng, data, form.kind) if file == form.file else data)
        return folder


def main() -> None:
    """Tasks come as JSON lines (format, seed, first case, last case + 1) on standard input."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--keep", type=Path, help="a folder where the spoilt files of the last case stay")
    arguments = parser.parse_args()
    if arguments.list:
        sys.stdout.write(json.dumps({name: [f.weight, list(f.readers)] for name, f in FORMATS.items()}))
        return
    report = os.fdopen(int(os.environ["FUZZ_REPORT"]), "w", buffering=1)
    faulthandler.enable()
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, _stop)
    tasks = [json.loads(line) for line in sys.stdin]
    with tempfile.TemporaryDirectory() as root:
        bench = Bench(arguments.keep or Path(root))
        for name, *_ in tasks:
            report.write(f"prepare {name} 0\n")
            bench.prepare(name)
        limit = _virtual_bytes() + MORE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for name, seed, first, stop in tasks:
            for case in range(first, stop):
                report.write(f"begin {name} {case}\n")
                folder = bench.spoil(name, seed, case)
                if (wrong := outcome(FORMATS[name], folder)) is not None:
                    report.write(f"wrong {name} {case} {json.dumps(wrong)}\n")
    report.write("end - 0\n")


if __name__ == "__main__":
    main()
