"""How good the sensors really are: what a smoothed first part of the drive says against the stated figures.

Questions to the fixes, the IMU, and wheels and receiver velocities, each answered so that outliers and bad stretches do
not decide, and acted on only where the answer is clear (three standard deviations of what chance would do).
"""

from graphnav.judgement.chance import MOST_RAISED
from graphnav.judgement.fixes import FIXES
from graphnav.judgement.imu import calmer, exhausted
from graphnav.judgement.rounds import judged
from graphnav.judgement.speeds import BLOCK, judge_speeds, raised_by

__all__ = ["BLOCK", "FIXES", "MOST_RAISED", "calmer", "exhausted", "judge_speeds", "judged", "raised_by"]
