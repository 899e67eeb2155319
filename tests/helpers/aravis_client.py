"""A client of GigE Vision cameras by Aravis: run by the system's Python, which has Debian's gir1.2-aravis-0.8.

Sets features from a JSON object in the first argument, acquires the number of frames in the second from the camera at
127.0.0.1, and prints a line of JSON for each: status, number, timestamp, Unix time of arrival, digest of its bytes.
"""

import hashlib
import json
import sys
import time

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

camera = Aravis.Camera.new("127.0.0.1")
device = camera.get_device()
for name, value in json.loads(sys.argv[1]).items():
    if isinstance(value, str):
        device.set_string_feature_value(name, value)
    elif isinstance(value, float):
        device.set_float_feature_value(name, value)
    else:
        device.set_integer_feature_value(name, value)
stream = camera.create_stream(None, None)
for _ in range(10):
    stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
camera.start_acquisition()
for _ in range(int(sys.argv[2])):
    buffer = stream.timeout_pop_buffer(10_000_000)
    if buffer is None:
        break
    arrival_s = time.time()
    line = {
        "status": buffer.get_status().value_nick,
        "id": buffer.get_frame_id(),
        "t_ns": buffer.get_timestamp(),
        "arrival_s": arrival_s,
        "digest": hashlib.sha256(buffer.get_data()).hexdigest(),
    }
    print(json.dumps(line), flush=True)
    stream.push_buffer(buffer)
camera.stop_acquisition()
