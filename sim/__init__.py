"""A virtual aircraft, and the sensors and the autopilot on it: the truth that everything else is measured against.

On the command line:

    python -m sim all          an aircraft that stands still, its serial devices on pseudo-terminals, its autopilot on
                               UDP, and a configuration for the companion that fits
    python -m sim devices      the devices alone
    python -m sim autopilot    the autopilot alone
    python -m sim ardupilot    a real ArduPilot SITL binary on the same aircraft, and the devices; `px4`: a real PX4
    python -m sim residuals    what each calibration leaves in a real autopilot, beside the truth

In a test, on any event loop, also one whose clock jumps:

    aircraft = VirtualAircraft(Pose(pitch_deg=5, roll_deg=-3, heading_deg=40), motions=[...])
    imu = ImuModel(aircraft, "icm42688p", seed=1, gyro_bias_rad_s=(5e-4, -3e-4, 8e-4))
    autopilot = ArduPilotDouble(aircraft, [imu])
    Wire(link, autopilot)                                # tests.support.wire
    running = asyncio.create_task(autopilot.run())
    ...
    autopilot.residual(1, loop.time())                   # what the calibration has left, in vehicle axes
    autopilot.writes                                     # every PARAM_SET that arrived, and whether it was armed

    aircraft, motions    where and how it stands, what happens to it         earth       frames, gravity, Earth rate
    imu_model            noise and bias of named parts, true bias at hand    devices     frames of serial devices
    pty_device           a device as a path that can be unplugged            ardupilot, px4   the doubles
    scenario             ready-made worlds                                   station     a bare MAVLink peer
    sitl                 physics for real firmware binaries

Nothing here uses the companion's physics, protocols or calibration: the simulator would only repeat their mistakes.
"""
