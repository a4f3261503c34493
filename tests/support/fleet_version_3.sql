CREATE TABLE items (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    format_version BIGINT NOT NULL,
    kind TEXT,
    at TIMESTAMP WITH TIME ZONE,
    clock TEXT,
    received_at TIMESTAMP WITH TIME ZONE NOT NULL,
    state VARCHAR(8) NOT NULL,
    same VARCHAR(32),
    payload TEXT NOT NULL,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE INDEX items_state ON items (state) WHERE state != 'taken';
CREATE INDEX items_same ON items (aircraft, same);
CREATE TABLE aircraft (
    aircraft VARCHAR(36) NOT NULL,
    name TEXT,
    epoch VARCHAR(16),
    first BIGINT,
    last BIGINT,
    hello_at TIMESTAMP WITH TIME ZONE,
    heard_at TIMESTAMP WITH TIME ZONE,
    PRIMARY KEY (aircraft)
);
CREATE TABLE calibrations (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    started_at TIMESTAMP WITH TIME ZONE NOT NULL,
    duration_s DOUBLE PRECISION NOT NULL,
    state VARCHAR(16) NOT NULL,
    reason TEXT NOT NULL,
    held_back TEXT NOT NULL,
    undone_at TIMESTAMP WITH TIME ZONE,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE INDEX calibrations_started_at ON calibrations (aircraft, started_at);
CREATE TABLE biases (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    imu VARCHAR(64) NOT NULL,
    axis VARCHAR(1) NOT NULL,
    gyro_id BIGINT,
    accel_id BIGINT,
    temperature_degc DOUBLE PRECISION,
    gyro_bias_rad_s DOUBLE PRECISION,
    gyro_sigma_stat_rad_s DOUBLE PRECISION,
    gyro_sigma_use_rad_s DOUBLE PRECISION,
    accel_bias_m_s2 DOUBLE PRECISION,
    accel_sigma_stat_m_s2 DOUBLE PRECISION,
    accel_sigma_use_m_s2 DOUBLE PRECISION,
    PRIMARY KEY (aircraft, epoch, sequence, imu, axis)
);
CREATE TABLE armings (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    armed_at TIMESTAMP WITH TIME ZONE NOT NULL,
    state VARCHAR(16) NOT NULL,
    reason TEXT NOT NULL,
    calibration_at TIMESTAMP WITH TIME ZONE,
    gyro_sigma_use_rad_s DOUBLE PRECISION,
    accel_sigma_use_m_s2 DOUBLE PRECISION,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE INDEX armings_armed_at ON armings (aircraft, armed_at);
CREATE TABLE undos (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    what TEXT NOT NULL,
    of_at TIMESTAMP WITH TIME ZONE NOT NULL,
    undone_at TIMESTAMP WITH TIME ZONE NOT NULL,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE TABLE alignments (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    what TEXT NOT NULL,
    state VARCHAR(16) NOT NULL,
    measured_at TIMESTAMP WITH TIME ZONE NOT NULL,
    reason TEXT NOT NULL,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE TABLE events (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    at TIMESTAMP WITH TIME ZONE,
    what TEXT NOT NULL,
    body TEXT NOT NULL,
    PRIMARY KEY (aircraft, epoch, sequence)
);
CREATE TABLE curves (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    triad VARCHAR(8) NOT NULL,
    axis VARCHAR(1) NOT NULL,
    degc DOUBLE PRECISION NOT NULL,
    at TIMESTAMP WITH TIME ZONE,
    imu VARCHAR(64) NOT NULL,
    power_ups BIGINT NOT NULL,
    bias DOUBLE PRECISION NOT NULL,
    sigma DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (aircraft, epoch, sequence, triad, axis, degc)
);
CREATE TABLE flights (
    aircraft VARCHAR(36) NOT NULL,
    epoch VARCHAR(16) NOT NULL,
    sequence BIGINT NOT NULL,
    instance BIGINT NOT NULL,
    triad VARCHAR(16) NOT NULL,
    axis VARCHAR(1) NOT NULL,
    flight TEXT NOT NULL,
    began_at TIMESTAMP WITH TIME ZONE,
    gyro_id BIGINT,
    accel_id BIGINT,
    calibration_at TIMESTAMP WITH TIME ZONE,
    drift_s DOUBLE PRECISION,
    drift_m DOUBLE PRECISION,
    in_flight DOUBLE PRECISION,
    in_flight_sigma DOUBLE PRECISION,
    turn_on DOUBLE PRECISION,
    turn_on_sigma DOUBLE PRECISION,
    motors DOUBLE PRECISION,
    motors_sigma DOUBLE PRECISION,
    PRIMARY KEY (aircraft, epoch, sequence, instance, triad, axis)
);
CREATE TABLE rejected (
    digest VARCHAR(32) NOT NULL,
    times BIGINT NOT NULL,
    last_at TIMESTAMP WITH TIME ZONE NOT NULL,
    topic TEXT NOT NULL,
    reason TEXT NOT NULL,
    payload BYTEA NOT NULL,
    PRIMARY KEY (digest)
);
CREATE INDEX rejected_last_at ON rejected (last_at);
CREATE TABLE schema_version (
    version INTEGER NOT NULL
);
