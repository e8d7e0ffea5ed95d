"""What an arm of one's own can do, before anything is recorded: the page of `manip-il robot check`.

`joints.py`, `hand.py`, `starts.py`, `pictures.py` and `episodes.py` measure one thing each, `check.py` puts them
together, `advice.py` says what to change, `page.py` shows it.
"""
