"""Raw GNSS observations: reading them, placing the satellites, single-point positions.

Times are seconds on one clock with a known zero, given as seconds since the GPS epoch, so that double precision is
good to nanoseconds. Positions of satellites are Earth-centred, Earth-fixed (e) at the time of transmission.
"""
