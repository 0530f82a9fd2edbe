"""The files of the page."""

import re

import pytest

from hilctl.desk.static import FILES, file_response


@pytest.mark.parametrize("path", FILES)
def test_each_file_is_there_and_comes_with_its_headers(path):
    response = file_response(path)
    assert response.status_code == 200
    assert len(response.body) == int(response.headers["Content-Length"]) > 100
    assert response.headers["Content-Security-Policy"].startswith("default-src 'self';")
    assert response.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize("path", ["/x", "/../live.js", "/page/live.js", "", "//", "/live.js/"])
def test_nothing_else_is_served(path):
    assert file_response(path).status_code == 404


def test_the_page_names_no_address_outside_and_holds_no_script_of_its_own():
    """So that it works with the cable out, and a strict policy lets all of it through."""
    page = file_response("/").body.decode()
    script = file_response("/live.js").body.decode()
    assert not re.findall(r"""(?:https?:)?//[a-z0-9]""", page)
    assert not re.findall(r"""["'`](?:https?:)?//""", script)
    assert not re.findall(r"<script>|<style|style=|\son\w+=", page)
    assert "innerHTML" not in script
    asked = set(re.findall(r'(?:href|src)="([^"]+)"', page))
    assert {f"/{name}" for name in asked} == FILES.keys() - {"/"}
    ids = set(re.findall(r'id="([^"]+)"', page))
    assert set(re.findall(r'\$\("([^"]+)"\)', script)) <= ids
