"""Receives the overlay and the place of the C-arm with pyigtl.

    python3 check_igtl.py PORT   # served by tests/cli/igtl.rs
"""
import sys

import numpy as np
import pyigtl

client = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=int(sys.argv[1]))
place = client.wait_for_message("CArm", timeout=60)
assert place is not None and place.message_type == "TRANSFORM", place
picture = client.wait_for_message("Overlay", timeout=60)
assert picture is not None and picture.message_type == "IMAGE", picture
assert picture.world_coordinate_system == "ras" and picture.image.shape == (1, 256, 256), picture.image.shape
assert np.isfinite(picture.image).all() and 0 < picture.image.max() < 10, picture.image.max()
# The axes of the picture are those of the C-arm, and its middle is the C-arm's place.
steps = picture.ijk_to_world_matrix[:3, :3]
lengths = np.linalg.norm(steps, axis=0)
assert np.allclose(steps / lengths, place.matrix[:3, :3] * np.sign((steps * place.matrix[:3, :3]).sum(axis=0)), atol=1e-5)
assert np.allclose((steps / lengths)[:, :2], place.matrix[:3, :2], atol=1e-5)
middle = picture.ijk_to_world_matrix @ [127.5, 127.5, 0, 1]
assert np.allclose(middle[:3], place.matrix[:3, 3], atol=1e-3), (middle, place.matrix)

# The picture follows the C-arm of a client.
primary, secondary = np.radians([20.0, -25.0])
away = np.array([-np.cos(secondary) * np.sin(primary), np.cos(secondary) * np.cos(primary), np.sin(secondary)])
wanted = np.eye(4)
wanted[:3, 2] = away
client.send_message(pyigtl.TransformMessage(wanted, device_name="CArm"), wait=True)
for _ in range(400):
    moved = client.wait_for_message("CArm", timeout=60)
    if np.allclose(moved.matrix[:3, 2], away, atol=1e-4):
        break
else:
    sys.exit(f"the picture stays at {moved.matrix[:3, 2]}, not {away}")
assert not np.allclose(place.matrix[:3, 2], away, atol=0.1), "another direction than before"

# A place that is none changes nothing, however often it is sent.
for _ in range(3):
    client.send_message(pyigtl.TransformMessage(np.zeros((4, 4)), device_name="CArm"), wait=True)
for _ in range(40):
    kept = client.wait_for_message("CArm", timeout=60)
    assert np.allclose(kept.matrix[:3, 2], away, atol=1e-4), kept.matrix
client.stop()

# When that client has left, the picture is that of the first view again.
other = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=int(sys.argv[1]))
for _ in range(400):
    back = other.wait_for_message("CArm", timeout=60)
    if np.allclose(back.matrix, place.matrix, atol=1e-4):
        break
else:
    sys.exit(f"the picture stays at {back.matrix[:3, 2]} when the client has left")
other.stop()
print("pyigtl: an overlay of", picture.image.shape, "at", place.matrix[:3, 3])
