-- The bindings of ArduPilot that companion_arming.lua uses, faked. Reads commands from stdin, one a line, and prints
-- one line after each: the state of the authorisation. Argument 1: the script; 2: how mavlink behaves.
local path, kind = arg[1], arg[2] or "both"
local now = 0
local state, text = "none", ""
local said, queue = {}, {}
local values = { MAV_SYSID = 7 }
if kind == "4.5" then values = { SYSID_THISMAV = 7 } end

local meta = {}
local function stamp(ms)
    return setmetatable({ ms = ms }, meta)
end
meta.__sub = function(a, b) return stamp((a.ms - b.ms) % 2 ^ 32) end
meta.__index = { toint = function(self) return math.floor(self.ms) end }
function millis() return stamp(now % 2 ^ 32) end
function micros() return stamp((now * 1000) % 2 ^ 32 - (now * 1000 % 2 ^ 32 >= 2 ^ 31 and 2 ^ 32 or 0)) end

gcs = { send_text = function(_, severity, words) said[#said + 1] = severity .. ":" .. words end }
local parameters = {}
param = {
    get = function(_, name) return values[name] end,
    add_table = function(_, key, prefix, count) parameters.prefix = prefix; return key > 0 and count == 3 end,
    add_param = function(_, _, _, name, default)
        local full = parameters.prefix .. name
        if values[full] == nil then values[full] = default end
        return true
    end,
}
-- What the heading's guard sees: flight is as `fly` says, the rest as `set` does.
local flight = { healthy = 1, set = 0, armed = 0, yaw = 0, rate = 0 }
if kind ~= "4.4" then
    visual_odom = { healthy = function(_) return flight.healthy ~= 0 end }
end
local function angle(name)
    return function(_) return name == "yaw" and flight.yaw or 0 end
end
local suffix = kind == "4.5" and "" or "_rad"
ahrs = {
    get_posvelyaw_source_set = function(_) return flight.set end,
    set_posvelyaw_source_set = function(_, set) flight.set = set end,
}
for _, name in ipairs({ "roll", "pitch", "yaw" }) do ahrs["get_" .. name .. suffix] = angle(name) end
local vectors = {}
local function vector(x, y, z)
    return setmetatable({ x = function() return x end, y = function() return y end, z = function() return z end }, vectors)
end
vectors.__add = function(a, b) return vector(a:x() + b:x(), a:y() + b:y(), a:z() + b:z()) end
-- The IMUs: `fly sick k` makes IMU k (0..) unhealthy; every reading of the accelerometers is 1 more than the last in x.
local imus, read = tonumber(arg[3] or "2"), 0
local function healthy(_, k) return k < imus and flight.sick ~= k end
ins = {
    get_gyro_health = healthy,
    get_accel_health = healthy,
    get_gyro = function(_, k)
        assert(k < imus)
        return vector(0.125 * k, 0, flight.rate)
    end,
    get_accel = function(_, k)
        assert(k < imus)
        read = read + 1
        return vector(read, k, -9.75)
    end,
    get_temperature = function(_, k) return 40.5 + k end,
}
arming = {
    is_armed = function(_) return flight.armed ~= 0 end,
    get_aux_auth_id = function(_) return kind ~= "full" and 0 or nil end,
    set_aux_auth_passed = function(_, id) assert(id == 0); state, text = "passed", "" end,
    set_aux_auth_failed = function(_, id, words) assert(id == 0); state, text = "failed", words end,
}
local function bound(count, work)
    -- 4.5 wants exactly `count` arguments; later versions want the table before them, and take both.
    return function(...)
        local given = { ... }
        if given[1] == mavlink then
            if kind == "4.5" then error("too many arguments") end
            table.remove(given, 1)
        elseif kind == "colon" then
            error("argument #1: mavlink expected")
        end
        if #given ~= count then error("wrong number of arguments") end
        return work(table.unpack(given))
    end
end
local registered = {}
if kind ~= "4.4" then
    mavlink = {
        init = bound(2, function(depth, ids) assert(depth == ids) end),
        register_rx_msgid = bound(1, function(id)
            if kind == "taken" then error("no registrations free") end
            registered[id] = true
            return true
        end),
        receive_chan = bound(0, function()
            local first = table.remove(queue, 1)
            if first == nil then return end
            if first == "boom" then return {} end
            return first, 1, millis()
        end),
        send_chan = bound(3, function(port, id, payload)
            assert(#payload == 252)
            local hex = payload:gsub(".", function(byte) return ("%02x"):format(byte:byte()) end)
            said[#said + 1] = ("sent %d %d %s"):format(port, id, hex)
            return true
        end),
    }
end

local update = assert(loadfile(path))()
local wait = 200
if type(update) ~= "function" then update = nil end
local function show()
    print(state .. "|" .. text .. "|" .. table.concat(said, ";"))
    said = {}
    io.stdout:flush()
end
show()
for line in io.lines() do
    local word, rest = line:match("^(%S+)%s*(.*)$")
    if word == "run" then -- milliseconds
        local till = now + tonumber(rest)
        while now + wait <= till do
            now = now + wait
            flight.yaw = (flight.yaw + (flight.turns or 0) * wait / 1000 + math.pi) % (2 * math.pi) - math.pi
            update, wait = update()
        end
        now = till
    elseif word == "skip" then -- time passes and nothing runs
        now = now + tonumber(rest)
    elseif word == "set" then
        local name, value = rest:match("(%S+) (%S+)")
        values[name] = tonumber(value)
    elseif word == "fly" then -- healthy, set, armed; turns and rate in rad/s: of the heading, and by the gyro
        local name, value = rest:match("(%S+) (%S+)")
        flight[name] = tonumber(value)
    elseif word == "source" then
        said[#said + 1] = "set " .. flight.set + 1
    elseif word == "receive" then -- hexadecimal bytes of a message as ArduPilot hands it over
        queue[#queue + 1] = (rest:gsub("%x%x", function(two) return string.char(tonumber(two, 16)) end))
    elseif word == "break" then
        queue[#queue + 1] = "boom"
    end
    show()
end
