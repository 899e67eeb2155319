"""NAME: an attitude controller of one's own, as a program that skysim starts.

#   skysim run simsat_slew --frames 3 --program NAME='python NAME.py' --set motion.control.law=NAME
#   skysim study run rate_smear --program NAME='python NAME.py'

In Python a function works, too: `skysim.simulate(scene, controller=pd)` (docs, "Bring your controller").
"""

import json
import sys

import numpy as np
from scipy.spatial.transform import Rotation

# What comes once: period_s, inertia_kg_m2, authority_nm, actuators, bandwidth_rad_s, damping, options, ...
setup = json.loads(sys.stdin.readline())
inertia = np.array(setup["inertia_kg_m2"])
b = setup["bandwidth_rad_s"]
z = setup["damping"]
print(json.dumps({"ready": True}), flush=True)

# What comes every control period: the attitude as measured, the commanded one, rates, stored momentum.
for line in sys.stdin:
    now = json.loads(line)
    lab_from_body = Rotation.from_quat(now["lab_from_body_xyzw"])
    body_from_ref = lab_from_body.inv() * Rotation.from_quat(now["lab_from_ref_xyzw"])
    rate = np.array(now["rate_body_rad_s"])
    rate_error = rate - body_from_ref.apply(now["rate_ref_rad_s"])
    acceleration = body_from_ref.apply(now["acceleration_ref_rad_s2"])
    acceleration += b**2 * body_from_ref.as_rotvec() - 2 * z * b * rate_error
    momentum = inertia @ rate + np.array(now["momentum_nms"])
    torque = inertia @ acceleration + np.cross(rate, momentum)  # N m, in body axes
    print(json.dumps({"tick": now["tick"], "torque_nm": torque.tolist()}), flush=True)
