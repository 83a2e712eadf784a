"""Loads the module of examples/slicer with stand-ins for Slicer, and follows a connection: which calls reach Slicer.

    python3 check_slicer_module.py MODULE.py   # run by tests/cli/igtl.rs
"""
import importlib.util
import sys
from unittest.mock import MagicMock

sys.dont_write_bytecode = True
slicer, qt, vtk = MagicMock(name="slicer"), MagicMock(name="qt"), MagicMock(name="vtk")
vtk.calldata_type = lambda _: lambda method: method
qt.QTimer.singleShot = lambda _, call: call()
base = MagicMock()
for name in ("ScriptedLoadableModule", "ScriptedLoadableModuleLogic", "ScriptedLoadableModuleWidget"):
    setattr(base, name, type(name, (), {"__init__": lambda self, *_: None, "setup": lambda self: None}))
sys.modules |= {"slicer": slicer, "slicer.ScriptedLoadableModule": base, "qt": qt, "vtk": vtk}
specification = importlib.util.spec_from_file_location("NertcaLive", sys.argv[1])
module = importlib.util.module_from_spec(specification)
specification.loader.exec_module(module)


def node(kind, name):
    made = MagicMock(name=name)
    made.IsA.side_effect = lambda asked: asked == kind
    made.GetName.return_value = name
    return made


connector = slicer.mrmlScene.AddNewNodeByClass.return_value
slicer.mrmlScene.GetFirstNodeByName.return_value = None
states = []
logic = module.NertcaLiveLogic(states.append)
logic.connect_to("host", 4321)
slicer.mrmlScene.AddNewNodeByClass.assert_called_once_with("vtkMRMLIGTLConnectorNode", "nertca-vk")
connector.SetTypeClient.assert_called_once_with("host", 4321)
connector.Start.assert_called_once_with()
watched = [call.args for call in slicer.mrmlScene.AddObserver.call_args_list]
[(event, added)] = watched
assert event is slicer.vtkMRMLScene.NodeAddedEvent

overlay, vessels, other = node("vtkMRMLScalarVolumeNode", "Overlay"), node("vtkMRMLModelNode", "Vessels"), node("vtkMRMLModelNode", "Heart")
for received in (overlay, vessels, other):
    added(None, None, received)
slicer.util.setSliceViewerLayers.assert_called_once_with(background=overlay, fit=True)
slicer.app.layoutManager().sliceWidget("Red").mrmlSliceNode().RotateToVolumePlane.assert_called_once_with(overlay)
vessels.GetDisplayNode().SetActiveScalar.assert_called_once_with("Radius", vtk.vtkAssignAttribute.POINT_DATA)
other.CreateDefaultDisplayNodes.assert_not_called()

logic.disconnect()
connector.Stop.assert_called_once_with()
slicer.mrmlScene.RemoveNode.assert_called_once_with(connector)
assert connector.RemoveObserver.call_count == 2 and slicer.mrmlScene.RemoveObserver.call_count == 1
assert states[-1] == "not connected" and "waiting for the program" in states, states
widget = module.NertcaLiveWidget()
widget.layout = MagicMock()
widget.setup()
widget.on_toggled(True)
widget.cleanup()
print("the module connects, shows", overlay.GetName(), "and", vessels.GetName(), "and disconnects")
