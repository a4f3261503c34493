"""Entry point of the MQTT process, `python -m companion.mqtt`; the daemon starts it."""

from companion.links.system.process import run_child
from companion.mqtt.process import MEMORY_MIB, MqttProcess

run_child(MqttProcess, memory_mib=MEMORY_MIB)
