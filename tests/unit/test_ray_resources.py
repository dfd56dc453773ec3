"""`--ray-resources`: what each worker needs on a Ray node."""

import pytest

from offboard.cloud_server.config import ServerConfig
from offboard.common.errors import ConfigError


def test_amounts_are_numbers_by_name() -> None:
    """Whole and broken numbers from 0 on are taken."""
    assert ServerConfig(ray_resources='{"CPU": 2, "GPU": 0.5}').resources == {"CPU": 2.0, "GPU": 0.5}


@pytest.mark.parametrize("amount", ["-1", "NaN", "Infinity", "true", '"one"', "9" * 400])
def test_a_wrong_amount_is_one_line(amount: str) -> None:
    """Also one that no float can hold."""
    with pytest.raises(ConfigError, match=r"--ray-resources: .* is not JSON like"):
        _ = ServerConfig(ray_resources=f'{{"CPU": {amount}}}').resources
