"""A browser that has logged in before a page is opened."""

from __future__ import annotations

from urllib.parse import urlsplit

from playwright.sync_api import BrowserContext

from tests.tokens import SHARED_BEARER


def log_in(context: BrowserContext, url: str) -> None:
    """Give a browser the cookie of a server that has the token that tests share.

    A server with a token of the test's own refuses that, and a server that is away does not answer:
    then the browser has no cookie.
    """
    origin = "{0.scheme}://{0.netloc}".format(urlsplit(url))
    headers = SHARED_BEARER | {"Origin": origin}
    context.request.post(f"{origin}/api/v1/login", headers=headers, data={})
