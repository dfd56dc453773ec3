"""Token buckets: what may still be spent."""


class Bucket:
    """Fills by `rate` a unit up to `most`; taking more than is there leaves a debt."""

    def __init__(self, rate: float, most: float, level: float = 0.0) -> None:
        self.rate, self.most, self.level = rate, most, level

    def fill(self, units: float) -> None:
        self.level = min(self.most, self.level + self.rate * units)

    def take(self, amount: float) -> None:
        self.level -= amount
