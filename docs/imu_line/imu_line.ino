// Sends an InvenSense six-axis IMU as `$IMU` lines, 200 a second (see ../imu_line.md).
//
// Board:  any Arduino core with Wire: Uno, Nano, Mega, Leonardo, ESP32, RP2040, Teensy, ...
// Sensor: MPU-6000/6050, MPU-6500, MPU-9250/9255, ICM-20602, ICM-20689, on I2C at address 0x68 (AD0 low).
//         Not the ICM-20948 and not the ICM-426xx: their registers lie elsewhere.
// Wiring: VCC, GND, SDA, SCL. Breakouts for the Uno carry a regulator; bare 3.3 V parts need a level shifter there.
//
// Honest notes
// - Nothing is calibrated, filtered or rotated here. The companion measures the biases; its configuration has the
//   mounting. A board that lies face up shows +9.8 m/s^2 on z, because that is what its accelerometer measures.
// - The full scales are a compromise. 500 deg/s and 4 g clip in hard flying; then raise them (the noise hardly changes,
//   the resolution halves). A clipped value looks like any other value.
// - The time stamp is taken when the program sees the "data ready" bit, 0.1 to 0.2 ms after the fact, and does not
//   include the delay of the sensor's low-pass filter (about 4 ms at this setting). Both are constant enough for
//   averages; they are not good enough for vision-grade time alignment.
// - micros() of an Uno comes from a ceramic resonator: expect 0.1 to 0.5 percent of rate error. That is why the line
//   carries it and the host does not trust it blindly.
// - The clones sold as "MPU-6050" differ: some answer another WHO_AM_I, some have worse noise than the data sheet. An
//   unknown identity stops the program with a message instead of sending wrong units.
// - The project's tests compile this file against a stand-in for the Arduino headers and check every value it sends from
//   a simulated sensor. They do not run it on real boards. By arithmetic an Uno is busy for some 2 of its 5 ms a sample.

#include <Arduino.h>
#include <Wire.h>

static const unsigned long BAUD = 500000;  // exact on a 16 MHz AVR, where 230400 and 460800 are not; USB boards ignore it
static const uint8_t ADDRESS = 0x68;
static const uint8_t GYRO_RANGE = 1;   // 0..3: 250, 500, 1000, 2000 deg/s
static const uint8_t ACCEL_RANGE = 1;  // 0..3: 2, 4, 8, 16 g
static const uint8_t DIVIDER = 4;      // 1 kHz / (1 + 4) = 200 Hz
static const uint8_t LOW_PASS = 2;     // about 95 Hz: just below half the output rate

static const uint8_t SMPLRT_DIV = 0x19, CONFIG = 0x1A, GYRO_CONFIG = 0x1B, ACCEL_CONFIG = 0x1C, ACCEL_CONFIG_2 = 0x1D;
static const uint8_t INT_ENABLE = 0x38, INT_STATUS = 0x3A, ACCEL_XOUT_H = 0x3B, PWR_MGMT_1 = 0x6B, WHO_AM_I = 0x75;
static const uint8_t DATA_READY = 0x01;

static float gyroMicroRadPerCount, accelTenthMilliPerCount;  // 1e-6 rad/s and 1e-4 m/s^2, what the line resolves
static float centiDegreePerCount, centiDegreeAtZero;
static uint16_t sequence = 0;

static bool writeRegister(uint8_t reg, uint8_t value) {
  Wire.beginTransmission(ADDRESS);
  Wire.write(reg);
  Wire.write(value);
  return Wire.endTransmission() == 0;
}

static bool readRegisters(uint8_t reg, uint8_t *into, uint8_t count) {
  Wire.beginTransmission(ADDRESS);
  Wire.write(reg);
  if (Wire.endTransmission(false) != 0) return false;
  if ((int)Wire.requestFrom((int)ADDRESS, (int)count) != (int)count) return false;  // the one overload every core has
  for (uint8_t i = 0; i < count; i++) into[i] = (uint8_t)Wire.read();
  return true;
}

// Sets the sensor up; 0 when all went well, else the identity that it showed (0xFF: it did not answer).
static uint8_t setUpSensor() {
  uint8_t identity = 0xFF;
  if (!writeRegister(PWR_MGMT_1, 0x80)) return 0xFF;  // reset
  delay(100);
  if (!writeRegister(PWR_MGMT_1, 0x01)) return 0xFF;  // wake up, clock from the gyro's oscillator
  delay(50);
  if (!readRegisters(WHO_AM_I, &identity, 1)) return 0xFF;

  bool separateAccelFilter = true;
  switch (identity) {
    case 0x68:  // MPU-6000, MPU-6050: 340 counts per degree, 0 at 36.53
      centiDegreePerCount = 100.0f / 340.0f;
      centiDegreeAtZero = 3653.0f;
      separateAccelFilter = false;
      break;
    case 0x70:  // MPU-6500
    case 0x71:  // MPU-9250
    case 0x73:  // MPU-9255: 333.87 counts per degree, 0 at 21
      centiDegreePerCount = 100.0f / 333.87f;
      centiDegreeAtZero = 2100.0f;
      break;
    case 0x12:  // ICM-20602
    case 0x98:  // ICM-20689: 326.8 counts per degree, 0 at 25
      centiDegreePerCount = 100.0f / 326.8f;
      centiDegreeAtZero = 2500.0f;
      break;
    default:
      return identity;
  }
  const float gyroCountsPerDegS = 32768.0f / (250.0f * (1 << GYRO_RANGE));
  const float accelCountsPerG = 16384.0f / (1 << ACCEL_RANGE);
  gyroMicroRadPerCount = 1e6f * 0.017453293f / gyroCountsPerDegS;
  accelTenthMilliPerCount = 1e4f * 9.80665f / accelCountsPerG;

  bool good = writeRegister(CONFIG, LOW_PASS) && writeRegister(SMPLRT_DIV, DIVIDER) &&
              writeRegister(GYRO_CONFIG, GYRO_RANGE << 3) && writeRegister(ACCEL_CONFIG, ACCEL_RANGE << 3) &&
              writeRegister(INT_ENABLE, DATA_READY);
  if (good && separateAccelFilter) good = writeRegister(ACCEL_CONFIG_2, LOW_PASS);
  return good ? 0 : 0xFF;
}

// The line under way. An Uno has neither printf of floating point nor a fast division: digits come by subtraction.
static char line[128];
static uint8_t length;
static const uint32_t POWERS_OF_TEN[] = {1UL,      10UL,      100UL,      1000UL,      10000UL,
                                         100000UL, 1000000UL, 10000000UL, 100000000UL, 1000000000UL};

static void put(char letter) { line[length++] = letter; }

// Prints `value` in units of its last decimal: 12345 with 4 decimals is 1.2345.
static void putUnsigned(uint32_t value, uint8_t decimals) {
  bool begun = false;
  for (int8_t place = 9; place >= 0; place--) {
    char digit = '0';
    while (value >= POWERS_OF_TEN[place]) {
      value -= POWERS_OF_TEN[place];
      digit++;
    }
    if (digit != '0' || place <= (int8_t)decimals) begun = true;
    if (begun) put(digit);
    if (place > 0 && place == (int8_t)decimals) put('.');
  }
}

static void putFixed(float value, uint8_t decimals) {
  const bool negative = value < 0;
  const uint32_t whole = (uint32_t)((negative ? -value : value) + 0.5f);
  put(',');
  if (negative && whole > 0) put('-');
  putUnsigned(whole, decimals);
}

static int16_t counts(const uint8_t *bytes) { return (int16_t)((uint16_t)bytes[0] << 8 | bytes[1]); }

static void sendLine(uint32_t tMicros, const uint8_t *raw) {
  static const char HEX_DIGITS[] = "0123456789ABCDEF";
  length = 0;
  for (const char *head = "$IMU,"; *head; head++) put(*head);
  putUnsigned(sequence, 0);
  put(',');
  putUnsigned(tMicros, 0);
  for (uint8_t axis = 0; axis < 3; axis++) putFixed(counts(raw + 8 + 2 * axis) * gyroMicroRadPerCount, 6);
  for (uint8_t axis = 0; axis < 3; axis++) putFixed(counts(raw + 2 * axis) * accelTenthMilliPerCount, 4);
  putFixed(counts(raw + 6) * centiDegreePerCount + centiDegreeAtZero, 2);
  uint8_t checksum = 0;
  for (uint8_t i = 1; i < length; i++) checksum ^= (uint8_t)line[i];
  put('*');
  put(HEX_DIGITS[checksum >> 4]);
  put(HEX_DIGITS[checksum & 15]);
  put('\r');
  put('\n');
  Serial.write((const uint8_t *)line, length);
}

void setup() {
  Serial.begin(BAUD);
  Wire.begin();
  Wire.setClock(400000);
  for (;;) {
    const uint8_t problem = setUpSensor();
    if (problem == 0) return;
    // Not an $IMU line on purpose: the companion counts it as noise, a person at a terminal reads it.
    Serial.print("imu_line: no usable sensor at 0x68; WHO_AM_I = 0x");
    Serial.println(problem, HEX);
    delay(1000);
  }
}

void loop() {
  uint8_t status = 0, raw[14];
  if (!readRegisters(INT_STATUS, &status, 1) || !(status & DATA_READY)) return;
  const uint32_t tMicros = micros();
  // Accelerometer, temperature and gyro in one burst, so that they belong to one instant. A failed read sends nothing,
  // but is counted: the host sees the gap in the sequence.
  if (readRegisters(ACCEL_XOUT_H, raw, sizeof raw)) sendLine(tMicros, raw);
  sequence++;
}
