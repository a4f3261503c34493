"""Example: the companion's control socket in ROS 2. It needs rclpy, and nothing of the companion.

    python3 companion_ros2.py /run/companion.sock fc

Topics: `imu` (sensor_msgs/Imu, 5 Hz: readings of IMU "fc", the covariance of its bias by the last calibration) and
`diagnostics` (DiagnosticArray). Service `calibrate` (std_srvs/Trigger): it answers at the end of the calibration.
The companion has FRD axes in a NED world, ROS has FLU in ENU (REP 103, REP 145).
"""

import json
import math
import socket
import sys
import threading

FLU = (1.0, -1.0, -1.0)
NOT_KNOWN = [-1.0] + [0.0] * 8  # REP 145
LEVELS = {"good": b"\0", "wait": b"\1", "bad": b"\2"}


def ask(path, request):
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        connection.sendall(json.dumps(request).encode() + b"\n")
        yield from map(json.loads, connection.makefile())


def covariance(rows, first):
    """Convert the (3, 3) block of a (6, 6) covariance that starts at `first` to FLU, row by row."""
    block = [[row[first + k] for k in range(3)] for row in rows[first : first + 3]] if rows else [[None]]
    if any(value is None for row in block for value in row):
        return NOT_KNOWN
    return [FLU[i] * FLU[k] * block[i][k] for i in range(3) for k in range(3)]


def orientation(pose):
    """Return the quaternion from FLU to ENU, or None without a heading."""
    if pose is None or pose["heading_deg"] is None:
        return None
    angles_deg = pose["roll_deg"], -pose["pitch_deg"], 90.0 - pose["heading_deg"]
    (sr, sp, sy), (cr, cp, cy) = ([f(math.radians(angle) / 2.0) for angle in angles_deg] for f in (math.sin, math.cos))
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    return {"x": x, "y": y, "z": cr * cp * sy - sr * sp * cy, "w": cr * cp * cy + sr * sp * sy}


def imu(reply, record, name):
    """Return the fields of sensor_msgs/Imu from a reply of `monitor` and the last record; None: no new readings."""
    if (read := reply["imus"].get(name)) is None:
        return None
    good = record is not None and record["state"] == "done" and not record["undone_at"]
    rows = next((each["covariance"] for each in record["imus"] if each["name"] == name), None) if good else None
    fields = {"orientation_covariance": NOT_KNOWN}
    if (quaternion := orientation(reply["pose"])) and good and record["pose"]:
        sigma = [math.radians(record["pose"]["sigma_deg"][angle] or math.inf) for angle in ("gamma", "theta", "psi")]
        squares = [sigma[i] ** 2 if i == k else 0.0 for i in range(3) for k in range(3)]
        fields = {"orientation": quaternion, "orientation_covariance": squares}
    for field, key, first in (("angular_velocity", "gyro_rad_s", 0), ("linear_acceleration", "accel_m_s2", 3)):
        fields[field] = {axis: FLU[k] * read[key][k] for k, axis in enumerate("xyz")}
        fields[f"{field}_covariance"] = covariance(rows, first)
    return fields


def diagnostics(status):
    """Return the fields of diagnostic_msgs/DiagnosticArray: the state, each device, each warning."""
    head = status["headline"]
    rows = [(head["tone"], "state", f"{head['word']}: {head['reason']}")]
    rows += [("good" if one["good"] else "bad", one["name"], one["summary"]) for one in status["devices"]]
    rows += [("wait", f"warning {k}", words) for k, words in enumerate(status["warnings"], 1)]
    return {"status": [{"level": LEVELS[a], "name": f"companion: {b}", "message": c} for a, b, c in rows]}


def calibrate(path):
    """Calibrate; return success and the reason in one line."""
    *_, last = ask(path, {"command": "calibrate", "wait": True})
    result = last.get("record") or last
    return result.get("state") == "done", result.get("reason", "the companion ended its answer early")


def main(path="/run/companion.sock", name="fc"):
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rosidl_runtime_py import set_message_fields
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger

    def publish(publisher, message, fields):
        set_message_fields(message, fields)
        message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), "base_link"
        publisher.publish(message)

    def follow(record=None):
        for reply in ask(path, {"command": "monitor", "pose": True, "samples": True}):
            record = reply.get("record", record)
            if fields := imu(reply, record, name):
                publish(imus, Imu(), fields)
            if "status" in reply:
                publish(states, DiagnosticArray(), diagnostics(reply["status"]))

    def on_calibrate(_request, response):
        response.success, response.message = calibrate(path)
        return response

    rclpy.init()
    node = rclpy.create_node("companion")
    imus = node.create_publisher(Imu, "imu", 10)
    states = node.create_publisher(DiagnosticArray, "diagnostics", 10)
    node.create_service(Trigger, "calibrate", on_calibrate)
    threading.Thread(target=follow, daemon=True).start()
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
