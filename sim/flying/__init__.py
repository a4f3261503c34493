"""Real firmware flies by its own physics, and the companion's sensors follow its truth: what faults do to the heading.

truth       an aircraft whose truth is told by a firmware: what the virtual sensors measure, and the record of a flight
verdict     from that record to the figures of a flight and whether they are good enough; pure
faults      what happens in the air: killed, stopped, unplugged, a heading that drifts, a compass that lies
vehicle     what a flying firmware is: start, set-up, take-off, hold
ardupilot   ArduPilot's own multicopter and plane
px4         PX4's own quadrotor
flight      one flight from power-up to verdict
cli         `python -m sim fly`
"""
