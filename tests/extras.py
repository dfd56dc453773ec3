"""The words with which Offboard says that an extra is missing."""


def needs(what: str, extra: str) -> str:
    """One line that names an install command; there is no package index to install Offboard from."""
    return f"{what} needs the extra '{extra}': run pip install '.[{extra}]' in a checkout of Offboard"
