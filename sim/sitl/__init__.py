"""Real autopilots on the virtual aircraft: physics for their binaries, and the binaries themselves as child processes.

    samples         readings of the aircraft's IMUs in blocks, in step with the firmware's own clock
    json_frames     ArduPilot's `--model JSON`: the two packets, without I/O
    json_backend    the UDP side of it
    hil_frames      PX4's HIL_SENSOR, HIL_GPS and HIL_ACTUATOR_CONTROLS, without I/O
    hil_backend     the TCP server PX4 connects to, in lockstep
    process         a binary in a folder and a process group of its own
    ardupilot, px4  one vehicle each: back end, binary, parameters, links, power cycle
    ground          a ground station for both firmwares
    daemon          the real companion beside them, with the aircraft's serial devices
    observe         what the firmware's telemetry says, beside the truth
    residuals       the table of what every calibration leaves
    cli             `python -m sim ardupilot | px4 | residuals`

The binaries are not part of this project; a path names them. What they are expected to do: autopilots 9.
"""
