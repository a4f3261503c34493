-- companion_arming.lua does three things. It lets ArduPilot arm only while the companion computer reports an active,
-- recent calibration. It changes to heading from gyros and GNSS when the companion's heading fails. It sends the output
-- of every IMU to the companion as floats, which no message of ArduPilot does.
--
-- Copyright the companion authors. SPDX-License-Identifier: Apache-2.0
--
-- Needs ArduPilot 4.5 or later on a board with more than 1 MB of flash and SCR_ENABLE = 1. Copy it to APM/scripts on
-- the SD card (or by MAVFTP) and reboot. The script holds an auxiliary authorisation: pre-arm checks fail, and show the
-- companion's reason, unless the companion has sent "accept" within the last 3 s. The script cannot prevent a forced
-- arming, nor arming between a boot (or a restart of scripting) and its own first line.
--
-- CMPG_ENABLE = 0 allows arming always (1: never without the companion). CMPG_COMPID: the companion's component id.
--
-- The verdict comes twice a second as TUNNEL (#385) from our own system, type 33191; payload: "CMPA", version 1, a
-- verdict byte (0 wait, 1 accept, 2 refuse, 3 gate switched off), then the reason as ASCII.
--
-- Payload "CMPF", version 1, requests IMU output. For 3 s after each request, while disarmed, the script sends about 11
-- DEBUG_FLOAT_ARRAY (#350) per second, named CMP_IMU, to the port of the request. For IMU 1, 2 and 3 they contain gyro
-- in rad/s, accelerometer in m/s^2 (means of four readings, FRD axes), temperature in deg C; zeros for a missing IMU.

local TUNNEL = 385
local PAYLOAD_TYPE = 33191
local MARK, ASK = "CMPA\1", "CMPF\1"
local ACCEPT, NOT_GATING = 1, 3
local SILENT_MS = 3000
local PERIOD_MS = 200
local GUARD_MS = 50
local LONGEST = 41 -- number of characters of a reason that ArduPilot shows
local TABLE_KEY = 191
local WARNING, INFO = 4, 6

-- Positions of the bytes in a received message: the packet's header, then the payload with its widest field first.
local AT_SYSTEM, AT_COMPONENT, AT_MESSAGE = 8, 9, 10
local AT_TYPE, AT_TARGET_SYSTEM, AT_TARGET_COMPONENT, AT_LENGTH, AT_PAYLOAD = 13, 15, 16, 17, 18

local auth_id = nil
local listening = false
local heard_ms = nil
local verdict = nil
local reason = ""
local trouble = nil

-- Heading: with EK3_SRC1_YAW = 6 the EKF uses only the companion's heading. The script selects another source set when
-- the companion's stream ends, or when in flight the heading turns but the gyros do not. In flight it selects set 3:
-- the gyros propagate the heading and GNSS corrects it, as a compass may be wrong then. On the ground it selects set 2,
-- the compass. It restores set 1 after 10 s of stream: the companion sends only a heading that agrees with the EKF. If
-- the heading turned by itself, it restores set 1 only once disarmed. A set that somebody else has selected stays.
-- CMPG_HEADING = 0 switches this function off.
local FROM_NONE, FROM_COMPASS, FROM_OUTSIDE = 0, 1, 6 -- values of EK3_SRCn_YAW
local SET_1, SET_2, SET_3 = 0, 1, 2
local LOST_MS = 300 -- in addition to the 300 ms after which visual_odom becomes unhealthy
local WELL_MS = 10000
local STRAYS_RAD = math.rad(5)
local STRAYS_WITHIN_S = 4
local LONGEST_STEP_S = 0.2
local STEEP_RAD = math.rad(60)

local is_guarding = false
local looked_ms = nil
local silent_since_ms, well_since_ms = nil, nil
local fell, is_latched = nil, false -- source set selected by this script as fallback
local strayed_rad, last_yaw_rad, last_ms = 0, nil, nil
local is_broken, floats_broken = false, false
local gated_ms, gate_after_ms = nil, PERIOD_MS

-- IMU output as floats: each is the mean of four readings, 20 ms apart.
local DEBUG_FLOAT_ARRAY = 350
local PAYLOAD_BYTES = 252
local NAME = "CMP_IMU"
local IMUS, READINGS, READ_MS, ASKED_MS = 3, 4, 20, 3000
local asked_ms, asked_port = nil, nil
local readings, gyro_sums, accel_sums = 0, {}, {}

-- Shorten a text to the length that ArduPilot shows, at the end of a word unless less than half would remain.
local function shorten(text)
    if #text <= LONGEST then
        return text
    end
    local words = string.match(string.sub(text, 1, LONGEST + 1), "^(.*[^ :;,])[:;,]* [^ ]*$")
    return words ~= nil and #words > LONGEST / 2 and words or string.sub(text, 1, LONGEST)
end

local function add_parameters()
    if param:add_table(TABLE_KEY, "CMPG_", 3) then
        param:add_param(TABLE_KEY, 1, "ENABLE", 1)
        param:add_param(TABLE_KEY, 2, "COMPID", 191)
        param:add_param(TABLE_KEY, 3, "HEADING", 1)
    else
        gcs:send_text(WARNING, "Companion gate: no parameters, defaults used")
    end
end

local function own_system()
    -- The parameter is MAV_SYSID from ArduPilot 4.7 on, SYSID_THISMAV before.
    return param:get("MAV_SYSID") or param:get("SYSID_THISMAV")
end

-- Call a function of the table `mavlink`. Later versions of ArduPilot need the table as first argument, earlier ones
-- refuse it.
local function call(name, ...)
    local ok = pcall(mavlink[name], ...)
    if not ok then
        ok = pcall(mavlink[name], mavlink, ...)
    end
    return ok
end

local function listen()
    if mavlink == nil then
        trouble = "Companion gate needs ArduPilot 4.5"
        return
    end
    -- The order of the two sizes differs between versions: equal sizes are right in all of them.
    if call("init", 10, 10) and call("register_rx_msgid", TUNNEL) then
        listening = true
    else
        trouble = "Companion gate: MAVLink used elsewhere"
    end
end

local function receive()
    local ok, message, port = pcall(mavlink.receive_chan)
    if not ok then
        ok, message, port = pcall(mavlink.receive_chan, mavlink)
    end
    if ok then
        return message, port
    end
    return nil
end

-- Read a little-endian unsigned number of `bytes` bytes.
local function number(message, at, bytes)
    local value = 0
    for k = bytes - 1, 0, -1 do
        value = value * 256 + (string.byte(message, at + k) or 0)
    end
    return value
end

local function take(message, port)
    if number(message, AT_MESSAGE, 3) ~= TUNNEL or number(message, AT_TYPE, 2) ~= PAYLOAD_TYPE then
        return
    end
    local own = own_system()
    local companion = param:get("CMPG_COMPID") or 191
    if own == nil or string.byte(message, AT_SYSTEM) ~= math.floor(own)
        or string.byte(message, AT_COMPONENT) ~= math.floor(companion)
        or string.byte(message, AT_TARGET_SYSTEM) ~= math.floor(own)
        or string.byte(message, AT_TARGET_COMPONENT) ~= 1 then
        return
    end
    local length = string.byte(message, AT_LENGTH) or 0
    local payload = string.sub(message, AT_PAYLOAD, AT_PAYLOAD + length - 1)
    if payload == ASK then
        asked_ms, asked_port = millis(), port
        return
    end
    if #payload <= #MARK or string.sub(payload, 1, #MARK) ~= MARK then
        return
    end
    verdict = string.byte(payload, #MARK + 1)
    reason = string.gsub(string.sub(payload, #MARK + 2), "[^\32-\126]", "?")
    heard_ms = millis()
end

local function judge()
    if trouble ~= nil then
        arming:set_aux_auth_failed(auth_id, shorten(trouble))
    elseif heard_ms == nil or (millis() - heard_ms):toint() > SILENT_MS then
        arming:set_aux_auth_failed(auth_id, "Companion silent: arming blocked")
    elseif verdict == ACCEPT or verdict == NOT_GATING then
        arming:set_aux_auth_passed(auth_id)
    elseif #reason > 0 then
        arming:set_aux_auth_failed(auth_id, shorten("Companion: " .. reason))
    else
        arming:set_aux_auth_failed(auth_id, "Companion: not ready")
    end
end

local function since_ms(then_ms)
    return (millis() - then_ms):toint()
end

-- Read the settings once a second: finding a parameter by its name is slow.
local function look()
    if looked_ms ~= nil and since_ms(looked_ms) < 1000 then
        return
    end
    looked_ms = millis()
    is_guarding = visual_odom ~= nil and param:get("CMPG_HEADING") ~= 0
        and param:get("EK3_SRC1_YAW") == FROM_OUTSIDE and param:get("EK3_SRC2_YAW") == FROM_COMPASS
        and param:get("EK3_SRC3_YAW") == FROM_NONE and param:get("EK3_SRC3_VELXY") ~= 0
end

local function angle_rad(name)
    local ok, found = pcall(function() return ahrs[name .. "_rad"](ahrs) end)
    return ok and found or ahrs[name](ahrs) -- name before ArduPilot 4.7
end

-- Return true if the heading has turned by more than 5 deg against the gyros within the last seconds.
local function strays()
    local roll, pitch, yaw = angle_rad("get_roll"), angle_rad("get_pitch"), angle_rad("get_yaw")
    local gyro, before, passed_s = ins:get_gyro(0), last_yaw_rad, last_ms ~= nil and since_ms(last_ms) / 1000 or 0
    last_yaw_rad, last_ms = yaw, millis()
    if before == nil or passed_s <= 0 or passed_s > LONGEST_STEP_S or math.abs(pitch) > STEEP_RAD
        or not arming:is_armed() then
        strayed_rad = 0
        return false
    end
    local turned = (yaw - before + math.pi) % (2 * math.pi) - math.pi
    local rate = (gyro:y() * math.sin(roll) + gyro:z() * math.cos(roll)) / math.cos(pitch)
    strayed_rad = strayed_rad * (1 - passed_s / STRAYS_WITHIN_S) + turned - rate * passed_s
    return math.abs(strayed_rad) > STRAYS_RAD
end

local function take_set(set, words)
    ahrs:set_posvelyaw_source_set(set)
    silent_since_ms, well_since_ms, last_yaw_rad, last_ms = nil, nil, nil, nil
    gcs:send_text(WARNING, words)
end

local function fall(why)
    fell = arming:is_armed() and SET_3 or SET_2
    take_set(fell, (fell == SET_3 and "Heading: gyros, " or "Heading: compass, ") .. why)
end

local function guard()
    look()
    if not is_guarding then
        return
    end
    local set, well = ahrs:get_posvelyaw_source_set(), visual_odom:healthy()
    if well then
        silent_since_ms, well_since_ms = nil, well_since_ms or millis()
    else
        silent_since_ms, well_since_ms = silent_since_ms or millis(), nil
    end
    if set == SET_1 then
        if silent_since_ms ~= nil and since_ms(silent_since_ms) >= LOST_MS then
            fall("none from companion")
        elseif strays() then
            is_latched = true
            fall("companion's drifts")
        end
    elseif set == fell then
        is_latched = is_latched and arming:is_armed()
        if not is_latched and well_since_ms ~= nil and since_ms(well_since_ms) >= WELL_MS then
            fell = nil
            take_set(SET_1, "Heading: companion")
        elseif fell == SET_3 and not arming:is_armed() then
            fall("landed")
        end
    else
        fell = nil -- somebody else has selected this set
    end
end

local function gate()
    if auth_id == nil then
        auth_id = arming:get_aux_auth_id()
        if auth_id == nil then
            return
        end
        arming:set_aux_auth_failed(auth_id, "Companion silent: arming blocked")
        listen()
        gcs:send_text(INFO, "Companion arming gate: active")
    end
    if listening then
        for _ = 1, 10 do
            local message, port = receive()
            if message == nil then
                break
            end
            take(message, port)
        end
    end
    if param:get("CMPG_ENABLE") == 0 then
        arming:set_aux_auth_passed(auth_id)
    else
        judge()
    end
end

local function is_asked()
    return not floats_broken and asked_ms ~= nil and since_ms(asked_ms) < ASKED_MS and not arming:is_armed()
end

-- Add one reading of each IMU. An IMU that was unhealthy at any of the four readings is sent as zeros.
local function read_imus()
    for i = 1, IMUS do
        local healthy = ins:get_gyro_health(i - 1) and ins:get_accel_health(i - 1)
        if readings == 0 then
            gyro_sums[i], accel_sums[i] = healthy and ins:get_gyro(i - 1), healthy and ins:get_accel(i - 1)
        elseif healthy and gyro_sums[i] then
            gyro_sums[i], accel_sums[i] = gyro_sums[i] + ins:get_gyro(i - 1), accel_sums[i] + ins:get_accel(i - 1)
        else
            gyro_sums[i] = false
        end
    end
    readings = readings + 1
end

local function send_floats()
    local parts = { string.pack("<i4i4I2c10", (micros()):toint(), 0, 1, NAME) }
    for i = 1, IMUS do
        local gyro, accel = gyro_sums[i], accel_sums[i]
        if gyro then
            parts[i + 1] = string.pack("<fffffff",
                gyro:x() / readings, gyro:y() / readings, gyro:z() / readings,
                accel:x() / readings, accel:y() / readings, accel:z() / readings, ins:get_temperature(i - 1))
        else
            parts[i + 1] = string.rep("\0", 28)
        end
    end
    local payload = table.concat(parts)
    call("send_chan", asked_port, DEBUG_FLOAT_ARRAY, payload .. string.rep("\0", PAYLOAD_BYTES - #payload))
    readings = 0
end

local function tell_floats()
    read_imus()
    if readings >= READINGS then
        send_floats()
    end
end

-- An error must not stop the script, as its last authorisation would stay valid: errors forbid arming instead.
local function update()
    local ok, problem = pcall(guard)
    if not ok and not is_broken then
        is_broken = true
        gcs:send_text(WARNING, shorten("Companion heading: " .. tostring(problem)))
    end
    local again_ms = GUARD_MS
    if is_asked() then
        again_ms = READ_MS
        ok, problem = pcall(tell_floats)
        if not ok then
            floats_broken = true
            gcs:send_text(WARNING, shorten("Companion floats: " .. tostring(problem)))
        end
    else
        readings = 0
    end
    if gated_ms ~= nil and since_ms(gated_ms) < gate_after_ms then
        return update, again_ms
    end
    gated_ms, gate_after_ms = millis(), PERIOD_MS
    ok, problem = pcall(gate)
    if not ok then
        if auth_id ~= nil then
            arming:set_aux_auth_failed(auth_id, "Companion script error")
        end
        gcs:send_text(WARNING, shorten("Companion gate: " .. tostring(problem)))
        gate_after_ms = 5 * PERIOD_MS
    end
    return update, again_ms
end

add_parameters()
return update()
