"""What holds for all tests."""

import os

# most of the time of a first run is the C compiler's; what is tested here is not speed
os.environ.setdefault("APU_OPTIMISE", "1")
