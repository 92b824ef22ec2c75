"""Give readers damaged files, and tell what came of them.

    python studies/robustness/fuzz.py [--inputs N] [--report FILE]

Runs `tests/data/test_fuzz.py` in its long form, with new inputs every time. Exit code 1 when an input led to
anything but what it holds or a refusal in words, or took longer than 5 s. A million inputs take hours.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lcopa_bayes.core.files import write_text

TESTS = Path(__file__).parents[2] / "tests" / "data" / "test_fuzz.py"
HEADING = """# Damaged files

Files of a corpus, tables, workbooks and run folders are cut, spliced, encoded anew and filled with odd words
and numbers; a reader must give what the file holds or refuse it in words, without a warning, within 5 s."""


def main() -> int:
    """Run the tests; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--report", type=Path, help="file of the summary")
    given = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "summary.json"
        own = {"LCOPA_BAYES_FUZZ": str(given.inputs), "LCOPA_BAYES_FUZZ_SUMMARY": str(file)}
        command = [sys.executable, "-m", "pytest", "-q", "-n", "0", str(TESTS)]
        code = subprocess.run(command, env=os.environ | own, cwd=TESTS.parents[2]).returncode
        found = json.loads(file.read_text())
    rows = ["| reader | inputs | refused in words | longest [s] |", "|---|---:|---:|---:|"]
    for name, one in found["tests"].items():
        reader = name.removeprefix("test_").replace("_", " ")
        rows.append(f"| {reader} | {one['inputs']:,} | {one['refused']:,} | {one['longest']:.2f} |")
    before, peak = (number / 1000 for number in found["memory_kB"])
    total = sum(one["inputs"] for one in found["tests"].values())
    command_line = shlex.join(["python", "studies/robustness/fuzz.py", *sys.argv[1:]])
    took = f"`{command_line}` took {(time.monotonic() - began) / 60:.0f} minutes for {total:,} inputs"
    outcome = "some were neither read nor refused" if code else "every one was read or refused"
    said = f"{took}: {outcome}. Memory rose from {before:.0f} to {peak:.0f} MB."
    text = "\n".join([HEADING, "", said, "", *rows])
    print(text)
    if given.report:
        write_text(given.report, f"{text}\n")
    return int(code != 0)


if __name__ == "__main__":
    sys.exit(main())
