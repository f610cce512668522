"""Helpers: control periods at rest; the time series of a flight, and the alerts that they fire."""

import re
import shutil
import subprocess
from math import nan
from pathlib import Path

import yaml

from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import Histogram
from cloudrc.exposition.table import METRICS
from cloudrc.faults import measures
from cloudrc.messages import UPRIGHT, ZERO
from cloudrc.records import Control, Counted

MS = 1_000_000


def period(stamp_ms, basis_ms, **fields):
    """Make a control period at `stamp_ms`, cloud's clock, from odometry of `basis_ms`, world's."""
    still = dict.fromkeys(Control._fields, ZERO)
    still |= {"stamp_ns": round(stamp_ms * MS), "basis_stamp_ns": round(basis_ms * MS)}
    still |= {"epoch": 1, "counter": 0, "horizon": 0.0, "rtt": nan, "loop_delay": nan}
    still |= {"orientation_wxyz": UPRIGHT, "waypoint": 0, "yaw_rate": 0.0}
    return Control(**{**still, **fields})


RULES = Path(__file__).resolve().parents[2] / "charts" / "cloudrc" / "files" / "rules.yaml"
PERIOD = 5
"""Time between scrapes [s]."""
AFTER = 11
"""Time for which scrapes continue after a flight [s]."""
ROLES = ("world", "cloud", "teleop")


def series(flight):
    """Return every series of a flight, one value per scrape."""
    times = range(0, int(flight.now) + AFTER, PERIOD)
    values = {}
    for role in ROLES:
        for n, readings in enumerate(scrapes(flight, role, times)):
            for name, value in samples(role, readings):
                values.setdefault(name, ["_"] * len(times))[n] = f"{value:.9g}"
    return [{"series": name, "values": " ".join(each)} for name, each in values.items()]


def scrapes(flight, role, times):
    """Yield the readings of a process at each time [s]."""
    live, seen, sent = LiveMetrics(role, missions=role != "cloud"), 0, 0
    for time in times:
        records = measures.seen_by(flight, role, time)
        for record in records[seen:]:
            if isinstance(record, Counted) and record.name == "sent":
                if record.total < sent:  # a new process, which counts from 0
                    live = LiveMetrics(role, missions=role != "cloud")
                sent = record.total
            live.see([record])
        seen = len(records)
        ready = live.end is None or live.end.has_peer
        yield live.read() | {
            "cloudrc_build_info": {("1", role, "c"): 1.0},
            "cloudrc_ready": {(): float(ready)},
        }


def samples(role, readings):
    for name, reading in readings.items():
        if isinstance(reading, Histogram):
            yield f'{name}_sum{{instance="{role}"}}', reading.total
            yield f'{name}_count{{instance="{role}"}}', reading.cumulative()[-1]
            continue
        for labels, value in reading.items():
            named = zip(("instance", *METRICS[name].labels), (role, *labels), strict=True)
            inside = ",".join(f'{label}="{text}"' for label, text in named)
            yield f"{name}{{{inside}}}", value


def fired(flight, folder):
    """Return the alerts of the chart that a flight fires, evaluated by promtool."""
    expression = 'group by (alertname) (last_over_time(ALERTS{alertstate="firing"}[1d]))'
    test = {
        "interval": f"{PERIOD}s",
        "input_series": series(flight),
        "promql_expr_test": [{"expr": expression, "eval_time": f"{int(flight.now) + AFTER}s"}],
    }
    document = {"rule_files": ["rules.yaml"], "evaluation_interval": "5s", "tests": [test]}
    shutil.copy(RULES, folder / "rules.yaml")
    (folder / "tests.yaml").write_text(yaml.safe_dump(document))
    # The test expects no sample, so promtool lists every sample as unexpected.
    command = ["promtool", "test", "rules", "tests.yaml"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    found = set(re.findall(r'{alertname="(\w+)"}', done.stderr))
    assert (done.returncode, bool(found)) in ((0, False), (1, True)), done.stderr
    return found
