"""Every number that the API takes, as the API describes itself, with values that nobody means."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx

from tests.service.fake_node import FakeNode
from tests.service.running import Running

NUMBERS = ("NaN", "Infinity", "-Infinity", "-1", "1e308", "-1e308", "1" + "0" * 400, "1e999", "0x1")
"""As a query and as a number in JSON, which Python reads wider than RFC 8259."""


def refused_or_good(answer: httpx.Response, about: object) -> None:
    assert answer.status_code < 500, (about, answer.text)
    if answer.status_code >= 400:
        assert answer.headers["content-type"] == "application/problem+json", about
        assert len(answer.json()["detail"]) < 2000, about


def schemas(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield schema
    for one in schema.get("anyOf", ()):
        yield from schemas(one)


def is_number(schema: dict[str, Any]) -> bool:
    return any(one.get("type") in ("number", "integer") for one in schemas(schema))


def test_a_number_that_nobody_means_is_refused_with_a_reason(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(20, [5.0, 0.0])
    tared.finish(session)
    http = running.http
    described = http.get("/openapi.json").json()
    places = {"session_id": session.id, "node": "bench", "tare_id": "x"}
    places |= {"take_id": "x", "marker_id": "x", "name": "x", "calibration_id": "x", "job_id": "x"}
    tried = 0
    for path, operations in described["paths"].items():
        url = path.removeprefix("/api/v1").format(**places)
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "query" and is_number(parameter["schema"]):
                    for value in NUMBERS:
                        tried += 1
                        answer = http.request(method, url, params={parameter["name"]: value})
                        refused_or_good(answer, (url, parameter["name"], value))
                        assert answer.status_code == 422 or value in ("-1", "1e308"), value
            content = operation.get("requestBody", {}).get("content", {})
            reference = content.get("application/json", {}).get("schema", {}).get("$ref", "")
            body = described["components"]["schemas"].get(reference.rpartition("/")[2], {})
            for name, schema in body.get("properties", {}).items():
                others = {key: "trial" for key in body.get("required", ()) if key != name}
                if "node" in others:
                    others["node"] = "bench"
                for value in NUMBERS if is_number(schema) else ():
                    tried += 1
                    text = json.dumps(others)[:-1] + f', "{name}": {value}}}'
                    headers = {"Content-Type": "application/json"}
                    answer = http.request(method, url, content=text, headers=headers)
                    refused_or_good(answer, (url, name, value))
                    assert answer.status_code in (400, 422), (url, name, value)
    assert tried >= 5 * len(NUMBERS)
    assert len(running.sessions()) == 1
    assert session.now()["marker_count"] == 0
