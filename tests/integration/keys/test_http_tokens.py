"""Who may use the HTTP APIs of server and relay (docs/security.md), with real processes."""

from pathlib import Path
from typing import Any

import httpx
import pytest

from offboard.common import VERSION
from tests.integration.keys.servers import SAFE_HEADERS, TOKEN, Serve, token_file

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]


def test_http_needs_its_token(serve: Serve, tmp_path: Path) -> None:
    """Without the token all is 401, except pages without data, and /health and /ready, which say little."""
    served = serve(None, "--http", "0.0.0.0:0", "--token-file", str(token_file(tmp_path)))
    wrong = [None, "Bearer", "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}"]
    for authorization in wrong:
        headers = {"Authorization": authorization} if authorization else {}
        with httpx.Client(base_url=served.http, headers=headers) as http:
            for path in ("/metrics", "/config", "/tasks", "/live/looks", "/openapi.json", "/nothing"):
                refused = http.get(path)
                assert (refused.status_code, refused.headers["www-authenticate"]) == (401, "Bearer"), path
                assert VERSION not in refused.text
                assert SAFE_HEADERS.items() <= dict(refused.headers).items()
            assert http.get("/health").json() == {"healthy": True, "insecure": False}
            assert http.get("/ready").json() == {"ready": True}
    with httpx.Client(base_url=served.http, headers={"Authorization": f"Bearer {TOKEN}"}) as http:
        assert http.get("/health").json()["version"] == VERSION
        for path in ("/metrics", "/config", "/tasks", "/docs"):
            answer = http.get(path)
            assert answer.status_code == 200
            assert SAFE_HEADERS.items() <= dict(answer.headers).items()
            assert "default-src 'none'" in answer.headers["content-security-policy"]
            assert "server" not in answer.headers
        assert TOKEN not in http.get("/config").text
        for method in ("POST", "PUT", "PATCH", "DELETE"):
            for path in ("/config", "/tasks", "/health", "/metrics"):
                assert http.request(method, path).status_code == 405


def test_metrics_are_open_on_loopback(serve: Serve, tmp_path: Path) -> None:
    """On loopback /metrics needs no token, but /config does."""
    served = serve(None, "--token-file", str(token_file(tmp_path)))
    assert httpx.get(f"{served.http}/metrics").status_code == 200
    assert httpx.get(f"{served.http}/config").status_code == 401


def test_web_pages_of_others_are_kept_out(serve: Serve) -> None:
    """A web page in a browser on this computer is refused, by its origin or its name for loopback."""
    served = serve(None)
    port = served.http.rpartition(":")[2]
    assert httpx.get(f"{served.http}/config", headers={"Origin": "http://evil.example"}).status_code == 403
    assert httpx.get(f"{served.http}/config", headers={"Host": f"evil.example:{port}"}).status_code == 403
    assert httpx.get(f"{served.http}/config", headers={"Host": f"localhost:{port}"}).status_code == 200


def test_the_relay_needs_its_token(wan: Any, tmp_path: Path) -> None:
    """Without the token nobody reads or changes the link of the relay. /health is open."""
    relay = wan(1, "--http", "0.0.0.0:0", "--token-file", str(token_file(tmp_path)))
    with httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}") as http:
        assert http.get("/health").json() == {"status": "ok", "insecure": False}
        for method, path in (("GET", "/link"), ("PUT", "/link"), ("POST", "/reset"), ("POST", "/schedule")):
            assert http.request(method, path, json={"outage": True}).status_code == 401
        http.headers["Authorization"] = f"Bearer {TOKEN}"
        assert http.get("/link").json()["outage"] is False
        changed = http.put("/link", json={"outage": True})
        assert changed.json()["outage"] is True
        assert SAFE_HEADERS.items() <= dict(changed.headers).items()


def test_an_open_relay_is_insecure(wan: Any) -> None:
    """With --insecure anybody may command the relay, except web pages, and /health says so."""
    relay = wan(1, "--http", "0.0.0.0:0", "--insecure")
    url = f"http://127.0.0.1:{relay.http_port}"
    assert httpx.get(f"{url}/health").json()["insecure"] is True
    assert httpx.get(f"{url}/link").status_code == 200
    assert httpx.post(f"{url}/reset", headers={"Origin": "http://evil.example"}).status_code == 403
