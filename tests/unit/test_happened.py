"""What a record says in words of what became of its task."""

from tests import happened


def test_the_page_shows_what_records_say() -> None:
    """The table on the page is made from six situations that are played in virtual time."""
    page = happened.PAGE.read_text()
    assert happened.table() in page, "run `python -m tests.happened`"
