"""Check names and prose against the word list in ``tests/support/wording.toml``.

``python -m tests.wording`` prints one line for each finding and exits with 1 if there are any; ``--counts`` prints the
number of findings by category and folder instead.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from tests.support.wording import all_findings


def main() -> int:
    """Print the findings; return 1 if there are any."""
    parser = argparse.ArgumentParser(description="Check names and prose against tests/support/wording.toml.")
    parser.add_argument("--counts", action="store_true", help="print counts by category and folder")
    parser.add_argument("paths", nargs="*", help="only findings whose path begins with one of these")
    args = parser.parse_args()
    findings = [one for one in all_findings() if one.path.startswith(tuple(args.paths or [""]))]
    if args.counts:
        counts = Counter((one.category, "/".join(one.path.split("/")[:-1][:2]) or one.path) for one in findings)
        for (category, folder), count in sorted(counts.items()):
            print(f"{count:6} {category:10} {folder}")
    else:
        for one in findings:
            print(one)
    print(f"{len(findings)} findings", file=sys.stderr)
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
