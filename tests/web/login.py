"""A browser that has logged in before a page is opened."""

from __future__ import annotations

from contextlib import suppress
from urllib.parse import urlsplit

from playwright.sync_api import BrowserContext, Error

from tests.tokens import SHARED_BEARER


def log_in(context: BrowserContext, url: str) -> None:
    """Give a browser the cookie of a server that has the token that tests share.

    A server with a token of the test's own refuses that, one that is away does not answer, and a
    blank page has no server: then the browser has no cookie.
    """
    origin = "{0.scheme}://{0.netloc}".format(urlsplit(url))
    headers = SHARED_BEARER | {"Origin": origin}
    with suppress(Error):
        context.request.post(f"{origin}/api/v1/login", headers=headers, data={})
