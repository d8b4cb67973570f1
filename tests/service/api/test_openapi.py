"""The API says what there is: as links, as OpenAPI, and to people."""

from __future__ import annotations

import re

import httpx

from tests.service.running import Running, ServeWith, assert_refused

TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test


def site(running: Running, path: str, **headers: str) -> httpx.Response:
    return httpx.get(running.url + path, headers=headers, trust_env=False)


def test_the_index_names_every_route_and_what_has_no_gap_in_its_path_is_there(
    running: Running,
) -> None:
    index = site(running, "/api/v1").json()
    described = running.http.get("/openapi.json").json()["paths"]
    named = {(route["method"], route["href"]) for route in index["routes"]}
    assert named == {(method.upper(), path) for path, each in described.items() for method in each}
    assert len(named) > 40
    for route in index["routes"]:
        if route["method"] == "GET" and "{" not in route["href"]:
            answer = site(running, route["href"])
            # A zip file wants ids.
            assert answer.status_code == (422 if route["href"].endswith("/zip") else 200), route
    assert site(running, index["openapi"]).json()["openapi"].startswith("3.1")


def test_the_page_loads_nothing_but_files_of_this_server(running: Running) -> None:
    page = site(running, "/docs")
    assert page.headers["content-security-policy"].startswith("default-src 'self'; ")
    assert "unsafe" not in page.headers["content-security-policy"]
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert "/docs/swagger-ui-bundle.js" in loaded
    for address in loaded:
        assert address.startswith("/"), address
        assert site(running, address).status_code == 200, address
    bundle = site(running, "/docs/swagger-ui-bundle.js")
    assert bundle.headers["content-encoding"] == "gzip"
    assert bundle.headers["content-type"].startswith("text/javascript")


def test_nothing_else_of_the_package_is_served(running: Running) -> None:
    for name in ("redoc.standalone.js", "favicon.png", "__init__.py", "..%2f__init__.py"):
        answer = site(running, f"/docs/{name}")
        assert answer.status_code == 404, name
        assert answer.headers["content-type"] == "application/problem+json"


def test_a_private_server_shows_the_page_and_keeps_the_description_for_who_logs_in(
    serve_with: ServeWith,
) -> None:
    private = serve_with(token=TOKEN, is_private=True)
    assert site(private, "/docs").status_code == 200
    for path in ("/api/v1/openapi.json", "/api/v1"):
        assert_refused(site(private, path), 401, "private", "foottile invite")
        assert site(private, path, Authorization=f"Bearer {TOKEN}").status_code == 200
