"""`python -m companion.mqtt`: the MQTT process, started by the daemon."""

from companion.links.system.process import run_child
from companion.mqtt.process import MEMORY_MIB, MqttProcess

run_child(MqttProcess, memory_mib=MEMORY_MIB)
