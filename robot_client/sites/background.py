"""How often a robot works in the background: less often while other programs take its CPU."""

LOADED_SLOWER = 3  # times as long are the pauses on a loaded robot


class Background:
    """The pauses of all background work of one offloader. That work takes CPU from the tasks.

    loaded: other programs take so much of the CPU that measured times show it.
    """

    def __init__(self) -> None:
        self.loaded = False

    def pause_s(self, usual_s: float) -> float:
        """The seconds to wait before the next step of work that is usually done this often."""
        return LOADED_SLOWER * usual_s if self.loaded else usual_s
