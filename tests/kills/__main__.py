"""`python -m tests.kills [COUNT SEED [JOB...]]`: kill commands at random moments, and print a table of what was left.

COUNT kills, 60 unless given, are shared out as `campaign.JOBS` says; a JOB is a part of a name, such as `dask`. COUNT 0
tries the troubles of the disk and the clock instead (`Campaign.troubles`). The results are kept in out/kills/SEED,
whose earlier content is removed.
"""

from __future__ import annotations

import shutil
import sys
import time
from functools import partial
from pathlib import Path

from tests.kills.campaign import JOBS, TROUBLES, Campaign, Job


def main() -> None:
    count, seed = (
        int(word) for word in (sys.argv[1:3] if len(sys.argv) > 2 else ("60", "1"))
    )
    names = sys.argv[3:]
    jobs = [one for one in JOBS if not names or any(name in one.name for name in names)]
    place = Path("out/kills", str(seed)).resolve()
    shutil.rmtree(place, ignore_errors=True)
    campaign = Campaign(place, seed, partial(print, flush=True))
    findings = (
        table_of_kills(campaign, jobs, count) if count else table_of_troubles(campaign, jobs)
    )
    print(*findings, sep="\n")
    sys.exit(bool(findings))


def table_of_kills(campaign: Campaign, jobs: list[Job], count: int) -> list[str]:
    """Kill the jobs, and print a row for each; return what was wrong."""
    share = count / sum(one.share for one in jobs)
    lines = [
        "| command | kills that hit | of them | resumed to identical | findings |",
        "|---|---|---|---|---|",
    ]
    findings = []
    for job in jobs:
        began_s = time.monotonic()
        result = campaign.run(job, max(1, round(job.share * share)))
        victims = ", ".join(f"{n} {name}" for name, n in result.by_victim.items())
        lines.append(
            f"| {job.name} | {result.kills} | {victims} | {result.identical} | {len(result.findings)} |"
        )
        findings += [f"{job.name}: {one}" for one in result.findings]
        print(*lines, f"{time.monotonic() - began_s:.0f} s", *findings, sep="\n", flush=True)
    return findings


def table_of_troubles(campaign: Campaign, jobs: list[Job]) -> list[str]:
    """Try the troubles of each job, and print a row for each; return what was wrong."""
    lines = [f"| command | {' | '.join(TROUBLES)} |", "|---|---|---|---|"]
    findings = []
    for job in jobs:
        if not job.on_dask:
            told = {name: getattr(campaign, name.replace(" ", "_"))(job) for name in TROUBLES}
            lines.append(f"| {job.name} | {' | '.join(one.line for one in told.values())} |")
            findings += [
                f"{job.name}, {name}: {one}"
                for name, all_ in told.items()
                for one in all_.findings
            ]
            print(*lines, *findings, sep="\n", flush=True)
    return findings


if __name__ == "__main__":
    main()
