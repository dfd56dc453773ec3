"""The image, without the others of the Compose project."""

import pytest

from tests.compose.conftest import docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]


def test_unit_tests_pass_in_the_image(engine: None) -> None:  # noqa: ARG001 - skips without an engine
    """The unit tests of what robots and servers run pass with the Python of the image, as its user."""
    docker("build", "--target", "test", "--tag", "offboard-unit", ".")
    version = docker("run", "--rm", "--entrypoint", "python3", "offboard-unit", "--version")
    output = docker("run", "--rm", "offboard-unit")
    print(f"{version}: {output.splitlines()[-1]}")
    assert " passed" in output.splitlines()[-1]
