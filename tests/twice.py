"""Runs pytest; repeats the few tests that failed, one after the other, and names those that passed then.

`python -m tests.twice ARGUMENTS`: the arguments are pytest's. A test that passes only when nothing runs next
to it is to be mended, but costs nobody a whole run. One that fails twice is a failure, and so are more than
REPEATED_MAX.
"""

import json
import subprocess
import sys
from pathlib import Path

REPEATED_MAX = 10
FAILED = Path(".pytest_cache/v/cache/lastfailed")
TESTS_FAILED = 1  # pytest's exit code; all others are errors of another kind


def main() -> int:
    """Returns pytest's exit code."""
    pytest = [sys.executable, "-m", "pytest"]
    FAILED.unlink(missing_ok=True)
    code = subprocess.run([*pytest, *sys.argv[1:]], check=False).returncode
    if code != TESTS_FAILED:
        return code
    failed = list(json.loads(FAILED.read_text()))
    if len(failed) > REPEATED_MAX:
        print(f"{len(failed)} tests failed; up to {REPEATED_MAX} would be repeated")
        return code
    print(f"repeated, with nothing next to them: {' '.join(failed)}", flush=True)
    code = subprocess.run([*pytest, *failed], check=False).returncode
    if code == 0:
        print(f"TO MEND: failed next to other tests, and passed alone: {' '.join(failed)}")
    return code


if __name__ == "__main__":
    sys.exit(main())
