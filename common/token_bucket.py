"""A token bucket, which limits an amount per unit of time or work."""


class Bucket:
    """Fills by `rate` per unit, up to `most`. The level may become negative: then something is owed."""

    def __init__(self, rate: float, most: float, level: float = 0.0) -> None:
        self.rate, self.most, self.level = rate, most, level

    def fill(self, units: float) -> None:
        self.level = min(self.most, self.level + self.rate * units)

    def take(self, amount: float) -> None:
        self.level -= amount
