"""`GET /metrics`: what a scraper reads, and what the dashboard asks of it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.service.api.access import TOKEN
from tests.service.fake_node import FakeNode
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import until

DASHBOARD = Path(__file__).resolve().parents[3] / "deploy" / "grafana.json"
PROMTOOL = shutil.which("promtool")
needs_promtool = pytest.mark.skipif(
    PROMTOOL is None, reason="no promtool; on Debian: sudo apt-get install prometheus"
)


def scrape(running: Running) -> str:
    answer = running.http.get(running.url + "/metrics")
    assert answer.status_code == 200, answer.text
    return answer.text


def read_series(running: Running) -> dict[tuple[str, ...], float]:
    """Values by name of the series, followed by its labels."""
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(scrape(running))
        for sample in family.samples
    }


def list_expressions() -> list[str]:
    """Queries of the dashboard's panels, with its variable replaced."""
    panels: list[dict[str, Any]] = json.loads(DASHBOARD.read_text())["panels"]
    return [one["expr"].replace("$node", ".*") for panel in panels for one in panel["targets"]]


def test_counts_of_a_node_are_those_of_the_api(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(100)
    node.frames(40)
    node.deliver(20)  # the 40 before are the backlog
    view, series = running.node(), read_series(running)
    assert view["backlog_frames"] == 40
    for name, expected in (
        ("connected", 1),
        ("received_frames_total", 120),
        ("backlog_frames", 40),
        ("warnings", 0),
        ("storage_failed", 0),
        ("nominal_frame_rate_hertz", view["nominal_rate_hz"]),
    ):
        assert series[f"foottile_node_{name}", node.name] == expected, name
    sent_bytes = series["foottile_node_received_bytes_total", node.name]
    assert series["foottile_node_backlog_bytes", node.name] == pytest.approx(sent_bytes / 3)
    assert series["foottile_node_last_frame_age_seconds", node.name] >= 0
    assert series["foottile_sync_seconds_count",] >= 1
    assert series["foottile_sync_seconds_sum",] > 0
    assert series["foottile_viewers",] == 0
    assert 0 < series["foottile_disk_free_bytes",] < series["foottile_disk_size_bytes",]


def test_lost_frames_and_sessions_have_reason_and_state(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(50)
    node.record()
    node.frames(30)
    node.say_lost(disk_full=[[50, 79]])
    node.deliver(20)
    series = read_series(running)
    assert series["foottile_node_lost_frames", node.name, "disk_full"] == 30
    assert series["foottile_unsealed_sessions", "recording"] == 1


def test_a_node_that_left_is_counted_on_as_not_connected(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(10)
    node.leave()
    until(lambda: read_series(running)["foottile_node_connected", node.name] == 0)
    series = read_series(running)
    assert series["foottile_node_frame_rate_hertz", node.name] == 0
    assert series["foottile_node_received_frames_total", node.name] == 10


def test_what_only_the_node_can_tell_is_left_out_while_it_is_away(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.say_clock(0, uncertainty_ns=1000)
    node.deliver(10)
    told = {
        f"foottile_node_{name}"
        for name in (
            *("backlog_frames", "backlog_bytes", "backlog_age_seconds", "warnings"),
            *("clock_offset_seconds", "clock_offset_bound_seconds"),
        )
    }
    until(lambda: told <= {name for name, *_ in read_series(running)})
    node.leave()
    until(lambda: read_series(running)["foottile_node_connected", node.name] == 0)
    assert not told & {name for name, *_ in read_series(running)}


def test_a_private_server_needs_the_token(serve_with: ServeWith) -> None:
    private = serve_with(token=TOKEN, is_private=True)
    assert_refused(private.http.get(private.url + "/metrics"), 401, "token")
    private.http.headers["Authorization"] = f"Bearer {TOKEN}"
    assert "foottile_viewers" in scrape(private)


def test_the_dashboard_asks_for_series_that_exist(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(10)
    families = list(text_string_to_metric_families(scrape(running)))
    # A family without a sample yet has no name of a sample.
    known = {sample.name for family in families for sample in family.samples}
    known |= {family.name + "_total" * (family.type == "counter") for family in families}
    expressions = list_expressions()
    asked = {name for one in expressions for name in re.findall(r"(?:foottile|process)_\w+", one)}
    assert asked <= known
    of_nodes = {name for name in known if name.startswith("foottile_node_")}
    assert len(of_nodes) > 10


@needs_promtool
def test_promtool_finds_nothing_wrong(running: Running, node: FakeNode, tmp_path: Path) -> None:
    node.connect()
    node.deliver(10)
    command = [str(PROMTOOL), "check", "metrics"]
    done = subprocess.run(command, input=scrape(running), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    rules = tmp_path / "rules.yml"
    rows = [{"record": f"a:b{i}", "expr": one} for i, one in enumerate(list_expressions())]
    rules.write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rows}]}))
    done = subprocess.run([str(PROMTOOL), "check", "rules", rules], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
