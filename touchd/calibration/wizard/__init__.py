"""Calibration step by step, for a person at a page: a process of its own, which outlives tabs and `touchd web`.

page -> `touchd web` -> socket -> `worker` -> control socket -> daemon

- `worker.py`: READ FIRST: takes commands, runs one job at a time, says its state to whoever watches
- `state.py`: what is known so far, on disk after each step: a restart goes on from there
- `untouched.py`: ten seconds that nobody touches; a finger begins them again
- `targets.py`, `tapping.py`: where to tap, and what a tap is worth
- `session.py`, `error_map.py`: what taps tell, kept tap by tap; the expected error over the plate
- `crosses.py`: where the screen lies, by touches at crosses
- `verbs.py`: `touchd calibrate` and `touchd train` in a child process
- `link.py`: the socket, for both ends
"""
