-- tellings: Keys of the items, each thing once: an aircraft with a new memory card tells some again under a new epoch
SELECT i.aircraft, i.epoch, i.sequence, i.clock
FROM items i
WHERE i.state = 'taken'
  AND NOT EXISTS (SELECT 1 FROM items o WHERE o.aircraft = i.aircraft AND o.same = i.same AND o.epoch < i.epoch);

-- standing: Calibrations that were done and not put back
SELECT c.*
FROM calibrations c
WHERE c.state = 'done' AND c.undone_at IS NULL
  AND NOT EXISTS (SELECT 1 FROM undos u
                  WHERE u.aircraft = c.aircraft AND u.what = 'calibration' AND u.of_at = c.started_at);

-- latest: Keys of what counts now of each aircraft: the latest by number on its present memory card, else by time
SELECT a.aircraft, a.name, a.heard_at,
  COALESCE((SELECT o.epoch FROM standing o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.epoch FROM standing o WHERE o.aircraft = a.aircraft
            ORDER BY o.started_at DESC LIMIT 1)) AS force_epoch,
  COALESCE((SELECT o.sequence FROM standing o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.sequence FROM standing o WHERE o.aircraft = a.aircraft
            ORDER BY o.started_at DESC LIMIT 1)) AS force_sequence,
  COALESCE((SELECT o.epoch FROM calibrations o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.epoch FROM calibrations o WHERE o.aircraft = a.aircraft
            ORDER BY o.started_at DESC LIMIT 1)) AS tried_epoch,
  COALESCE((SELECT o.sequence FROM calibrations o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.sequence FROM calibrations o WHERE o.aircraft = a.aircraft
            ORDER BY o.started_at DESC LIMIT 1)) AS tried_sequence,
  COALESCE((SELECT o.epoch FROM armings o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.epoch FROM armings o WHERE o.aircraft = a.aircraft
            ORDER BY o.armed_at DESC LIMIT 1)) AS armed_epoch,
  COALESCE((SELECT o.sequence FROM armings o WHERE o.aircraft = a.aircraft AND o.epoch = a.epoch
            ORDER BY o.sequence DESC LIMIT 1),
           (SELECT o.sequence FROM armings o WHERE o.aircraft = a.aircraft
            ORDER BY o.armed_at DESC LIMIT 1)) AS armed_sequence
FROM aircraft a;

-- fleet: A row for each aircraft: what is in force, how the latest calibration and arming went, when it was heard
SELECT l.aircraft, l.name, l.heard_at, f.started_at AS calibrated_at, f.held_back,
       t.started_at AS tried_at, t.state AS tried_state, t.reason AS tried_reason,
       r.armed_at, r.state AS armed_state, r.reason AS armed_reason
FROM latest l
LEFT JOIN calibrations f ON f.aircraft = l.aircraft AND f.epoch = l.force_epoch AND f.sequence = l.force_sequence
LEFT JOIN calibrations t ON t.aircraft = l.aircraft AND t.epoch = l.tried_epoch AND t.sequence = l.tried_sequence
LEFT JOIN armings r ON r.aircraft = l.aircraft AND r.epoch = l.armed_epoch AND r.sequence = l.armed_sequence;

-- bias_history: Biases by calibration, IMU and axis, in deg/h and mg, each calibration once
SELECT b.aircraft, b.epoch, b.sequence, c.started_at, t.clock, b.imu, b.axis, b.gyro_id, b.accel_id,
       b.temperature_degc,
       b.gyro_bias_rad_s * 206264.80624709636 AS gyro_bias_deg_h,
       b.gyro_sigma_use_rad_s * 206264.80624709636 AS gyro_sigma_use_deg_h,
       b.accel_bias_m_s2 / 0.00980665 AS accel_bias_mg,
       b.accel_sigma_use_m_s2 / 0.00980665 AS accel_sigma_use_mg
FROM biases b
JOIN calibrations c ON c.aircraft = b.aircraft AND c.epoch = b.epoch AND c.sequence = b.sequence
JOIN tellings t ON t.aircraft = b.aircraft AND t.epoch = b.epoch AND t.sequence = b.sequence
WHERE c.state = 'done';

-- imus: IMUs by aircraft and device id; an autopilot numbers them alike on all boards of one make
SELECT aircraft, imu, gyro_id, accel_id,
       MIN(started_at) AS first_at, MAX(started_at) AS last_at, COUNT(*) AS calibrations
FROM bias_history
WHERE axis = 'x'
GROUP BY aircraft, imu, gyro_id, accel_id;

-- calibration_history: Calibrations however they ended, each once, with when they were put back
SELECT c.aircraft, a.name, c.epoch, c.sequence, c.started_at, t.clock, c.duration_s, c.state, c.reason, c.held_back,
       COALESCE(c.undone_at, (SELECT MIN(u.undone_at) FROM undos u
                              WHERE u.aircraft = c.aircraft AND u.what = 'calibration' AND u.of_at = c.started_at)) AS undone_at
FROM calibrations c
JOIN tellings t ON t.aircraft = c.aircraft AND t.epoch = c.epoch AND t.sequence = c.sequence
LEFT JOIN aircraft a ON a.aircraft = c.aircraft;

-- arming_history: Armings, each once
SELECT r.aircraft, a.name, r.epoch, r.sequence, r.armed_at, t.clock, r.state, r.reason, r.calibration_at
FROM armings r
JOIN tellings t ON t.aircraft = r.aircraft AND t.epoch = r.epoch AND t.sequence = r.sequence
LEFT JOIN aircraft a ON a.aircraft = r.aircraft;

-- flight_history: Biases in flight over what the offsets in force left, by IMU and axis, each flight once
SELECT aircraft, name, flight, began_at, instance, gyro_id, accel_id, calibration_at, drift_s, drift_m, triad, axis,
       CASE WHEN triad = 'gyro' THEN in_flight * 206264.80624709636 END AS in_flight_deg_h,
       CASE WHEN triad = 'gyro' THEN in_flight_sigma * 206264.80624709636 END AS in_flight_sigma_deg_h,
       CASE WHEN triad = 'gyro' THEN turn_on * 206264.80624709636 END AS turn_on_deg_h,
       CASE WHEN triad = 'gyro' THEN motors * 206264.80624709636 END AS motors_deg_h,
       CASE WHEN triad = 'accel' THEN in_flight / 0.00980665 END AS in_flight_mg,
       CASE WHEN triad = 'accel' THEN in_flight_sigma / 0.00980665 END AS in_flight_sigma_mg,
       CASE WHEN triad = 'accel' THEN turn_on / 0.00980665 END AS turn_on_mg,
       CASE WHEN triad = 'accel' THEN motors / 0.00980665 END AS motors_mg
FROM (SELECT f.*, a.name, RANK() OVER (
        PARTITION BY f.aircraft, f.flight
        ORDER BY CASE WHEN f.epoch = a.epoch THEN f.sequence END DESC NULLS LAST, f.epoch DESC, f.sequence DESC) AS place
      FROM flights f LEFT JOIN aircraft a ON a.aircraft = f.aircraft) AS numbered
WHERE place = 1;

-- part_scatter: How far the biases of each IMU that is in an aircraft scatter from power-up to power-up, and wander, by model
SELECT p.aircraft, a.name, p.imu, p.model, p.triad, p.axis, p.power_ups,
       CASE WHEN p.triad = 'gyro' THEN p.turn_on * 206264.80624709636 END AS turn_on_deg_h,
       CASE WHEN p.triad = 'gyro' THEN p.wander * 206264.80624709636 END AS wander_deg_h,
       CASE WHEN p.triad = 'accel' THEN p.turn_on / 0.00980665 END AS turn_on_mg,
       CASE WHEN p.triad = 'accel' THEN p.wander / 0.00980665 END AS wander_mg
FROM parts p LEFT JOIN aircraft a ON a.aircraft = p.aircraft;

-- sensor_findings: What calibrations say against the sensors of each aircraft, as of its latest; place 0 is the worst
SELECT f.aircraft, a.name, f.place, f.kind, f.imu, f.since, f.power_ups, f.size, f.words
FROM findings f LEFT JOIN aircraft a ON a.aircraft = f.aircraft;
