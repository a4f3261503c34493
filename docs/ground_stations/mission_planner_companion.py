"""Asks the companion (component 191) for a calibration, from Mission Planner: Data > Scripts > Select Script > Run.

Disarmed, and the aircraft still. Choose what is to be done in the next line; Data > Messages shows how it goes.
"""

DO = "calibrate"  # or "gyros", "accelerometers", "calibrate and reboot", "cancel", "undo"

import clr

clr.AddReference("MAVLink")
import MAVLink
from System import Byte

COMPANION = Byte(191)
# The command, then its param1 and param2.
ASKED = {
    "calibrate": (MAVLink.MAV_CMD.USER_1, 0, 0),
    "gyros": (MAVLink.MAV_CMD.USER_1, 1, 0),
    "accelerometers": (MAVLink.MAV_CMD.USER_1, 2, 0),
    "calibrate and reboot": (MAVLink.MAV_CMD.USER_1, 0, 1),
    "cancel": (MAVLink.MAV_CMD.USER_2, 0, 0),
    "undo": (MAVLink.MAV_CMD.USER_3, 0, 0),
}

command, param1, param2 = ASKED[DO]
print("Asking the companion to " + DO)
# Whatever is chosen at the top right, this goes to the companion of the vehicle that is chosen there.
done = MAV.doCommand(Byte(MAV.sysidcurrent), COMPANION, command, param1, param2, 0, 0, 0, 0, 0)
print("Done." if done else "NOT done: Data > Messages says why. No message at all: nothing of it has arrived.")
