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

-- in_force: The latest calibration of each aircraft that stands: by number on its present memory card, else by time
SELECT aircraft, epoch, sequence, started_at, held_back
FROM (SELECT s.*, ROW_NUMBER() OVER (
        PARTITION BY s.aircraft
        ORDER BY CASE WHEN s.epoch = a.epoch THEN s.sequence END DESC NULLS LAST, s.started_at DESC) AS place
      FROM standing s JOIN aircraft a ON a.aircraft = s.aircraft) AS numbered
WHERE place = 1;

-- latest_tries: The latest calibration of each aircraft, however it ended
SELECT aircraft, started_at, state, reason
FROM (SELECT c.*, ROW_NUMBER() OVER (
        PARTITION BY c.aircraft
        ORDER BY CASE WHEN c.epoch = a.epoch THEN c.sequence END DESC NULLS LAST, c.started_at DESC) AS place
      FROM calibrations c JOIN aircraft a ON a.aircraft = c.aircraft) AS numbered
WHERE place = 1;

-- latest_armings: The latest arming of each aircraft
SELECT aircraft, armed_at, state, reason
FROM (SELECT r.*, ROW_NUMBER() OVER (
        PARTITION BY r.aircraft
        ORDER BY CASE WHEN r.epoch = a.epoch THEN r.sequence END DESC NULLS LAST, r.armed_at DESC) AS place
      FROM armings r JOIN aircraft a ON a.aircraft = r.aircraft) AS numbered
WHERE place = 1;

-- fleet: A row for each aircraft: what is in force, how the latest calibration and arming went, when it was heard
SELECT a.aircraft, a.name, a.heard_at, f.started_at AS calibrated_at, f.held_back,
       t.started_at AS tried_at, t.state AS tried_state, t.reason AS tried_reason,
       r.armed_at, r.state AS armed_state, r.reason AS armed_reason
FROM aircraft a
LEFT JOIN in_force f ON f.aircraft = a.aircraft
LEFT JOIN latest_tries t ON t.aircraft = a.aircraft
LEFT JOIN latest_armings r ON r.aircraft = a.aircraft;

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
