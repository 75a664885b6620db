"""Makes docs/results.md of the JSON files in benchmarks/results: ``python -m benchmarks.results [--check]``.

A benchmark writes such a file with ``--out benchmarks/results/NAME.json``. The page's words and the choice of tables
are in benchmarks/results/results.md.j2. ``--check`` writes nothing; its exit code is 1 where the page is not what the
files give.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from benchmarks.published.literature import comparison
from benchmarks.record import Figures, table_head, table_row, written

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results", ROOT / "docs" / "results.md"


def table(rows: Iterable[Figures], columns: str) -> str:
    """The named columns of some rows."""
    keys = columns.split()
    return "\n".join([table_head(keys), *(table_row(keys, row) for row in rows)])


def page() -> str:
    """The text of docs/results.md. The template knows each file's rows by the file's name; figures are written out."""
    records = {path.stem: json.loads(path.read_text("utf-8")) for path in sorted(RESULTS.glob("*.json"))}

    def made(name: str) -> str:
        """Where the figures of a file come from, in brackets, as a sentence ends with it."""
        record = records[name]
        return f"(`{record['command']}` · {record['date']} · {record['machine']} · {record['commit']})"

    rows = {name: [written(row) for row in record["figures"]] for name, record in records.items()}
    published = records.get("published", {"figures": []})["figures"]
    template = Environment(undefined=StrictUndefined, autoescape=False, keep_trailing_newline=True).from_string(
        (RESULTS / "results.md.j2").read_text("utf-8")
    )
    return template.render(rows, table=table, made=made, comparison=comparison(published))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare only")
    if parser.parse_args().check:
        return int(PAGE.read_text("utf-8") != page())
    PAGE.write_text(page(), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
