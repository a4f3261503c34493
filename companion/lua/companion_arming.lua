-- companion_arming.lua: ArduPilot arms only while the companion computer says that a fresh calibration is in force.
--
-- Copyright the companion authors. SPDX-License-Identifier: Apache-2.0
--
-- Needs ArduPilot 4.5 or later on a board with more than 1 MB of flash and SCR_ENABLE = 1. Copy it to APM/scripts on
-- the SD card (or by MAVFTP) and reboot. It holds an auxiliary authorisation: pre-arm checks fail until the companion
-- has said "yes" within the last 3 s, and show its reason. What does not go through here: a forced arming; and the
-- moments between boot, or a restart of scripting, and this script's first line.
--
-- CMPG_ENABLE 0 opens the gate for good (1: closed without the companion). CMPG_COMPID is the companion's component id.
--
-- The verdict comes twice a second as TUNNEL (#385) from our own system, type 33191; payload: "CMPA", version 1, a
-- verdict byte (0 wait, 1 accept, 2 refuse, 3 the companion does not gate any more), then the reason as ASCII.

local TUNNEL = 385
local PAYLOAD_TYPE = 33191
local MARK = "CMPA\1"
local ACCEPT, NOT_GATING = 1, 3
local SILENT_MS = 3000
local PERIOD_MS = 200
local LONGEST = 41 -- what ArduPilot shows of a reason
local TABLE_KEY = 191
local WARNING, INFO = 4, 6

-- Where the bytes of a received message lie: the packet's header, then the payload with its widest field first.
local AT_SYSTEM, AT_COMPONENT, AT_MESSAGE = 8, 9, 10
local AT_TYPE, AT_TARGET_SYSTEM, AT_TARGET_COMPONENT, AT_LENGTH, AT_PAYLOAD = 13, 15, 16, 17, 18

local auth_id = nil
local listening = false
local heard_ms = nil
local verdict = nil
local reason = ""
local trouble = nil

local function shorten(text)
    return string.sub(text, 1, LONGEST)
end

local function add_parameters()
    if param:add_table(TABLE_KEY, "CMPG_", 2) then
        param:add_param(TABLE_KEY, 1, "ENABLE", 1)
        param:add_param(TABLE_KEY, 2, "COMPID", 191)
    else
        gcs:send_text(WARNING, "Companion gate: no parameters, defaults used")
    end
end

local function own_system()
    -- MAV_SYSID from 4.7 on, SYSID_THISMAV before
    return param:get("MAV_SYSID") or param:get("SYSID_THISMAV")
end

-- Later versions want the table as first argument, earlier ones must not get it.
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
    -- The two sizes changed places between versions: equal ones are right in all.
    if call("init", 10, 10) and call("register_rx_msgid", TUNNEL) then
        listening = true
    else
        trouble = "Companion gate: MAVLink used elsewhere"
    end
end

local function receive()
    local ok, message = pcall(mavlink.receive_chan)
    if not ok then
        ok, message = pcall(mavlink.receive_chan, mavlink)
    end
    if ok then
        return message
    end
    return nil
end

-- Little endian, of so many bytes.
local function number(message, at, bytes)
    local value = 0
    for k = bytes - 1, 0, -1 do
        value = value * 256 + (string.byte(message, at + k) or 0)
    end
    return value
end

local function take(message)
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

local function step()
    if auth_id == nil then
        auth_id = arming:get_aux_auth_id()
        if auth_id == nil then
            return
        end
        arming:set_aux_auth_failed(auth_id, "Companion silent: arming blocked")
        add_parameters()
        listen()
        gcs:send_text(INFO, "Companion arming gate: active")
    end
    if listening then
        for _ = 1, 10 do
            local message = receive()
            if message == nil then
                break
            end
            take(message)
        end
    end
    if param:get("CMPG_ENABLE") == 0 then
        arming:set_aux_auth_passed(auth_id)
    else
        judge()
    end
end

-- A script that stops on an error would leave its last word standing: so errors close the gate, and it goes on.
local function update()
    local ok, problem = pcall(step)
    if not ok then
        if auth_id ~= nil then
            arming:set_aux_auth_failed(auth_id, "Companion script error")
        end
        gcs:send_text(WARNING, shorten("Companion gate: " .. tostring(problem)))
        return update, 5 * PERIOD_MS
    end
    return update, PERIOD_MS
end

return update()
