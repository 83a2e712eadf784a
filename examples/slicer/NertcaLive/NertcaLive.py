"""Module of 3D Slicer that shows a live reconstruction: the vessels, and the picture of the first view in its plane.

`nertca-vk watch INBOX -o RUN --igtl 18944` sends them. The module needs the extension SlicerOpenIGTLink. To try it, add the folder of this
file in Slicer under Edit, Application Settings, Modules, Additional module paths.
"""

import qt
import slicer
import vtk
from slicer.ScriptedLoadableModule import ScriptedLoadableModule, ScriptedLoadableModuleLogic, ScriptedLoadableModuleWidget

# Names of the messages that the program sends.
OVERLAY, VESSELS = "Overlay", "Vessels"
DEFAULT_HOST, DEFAULT_PORT = "localhost", 18944
# Array at the points of the vessels, and the range of its colours, mm.
RADIUS = "Radius"
RADII_MM = (0.3, 2.5)


class NertcaLive(ScriptedLoadableModule):
    """Description of the module."""

    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "nertca-vk live"
        parent.categories = ["IGT"]
        parent.dependencies = ["OpenIGTLinkIF"]
        parent.contributors = ["nertca-vk"]
        parent.helpText = "Shows the reconstruction that `nertca-vk watch --igtl PORT` sends. Research use only, not for diagnosis."


class NertcaLiveWidget(ScriptedLoadableModuleWidget):
    """Address, a button that connects, and the state of the connection."""

    def setup(self):
        super().setup()
        self.logic = NertcaLiveLogic(self.show_state)
        form = qt.QFormLayout()
        self.layout.addLayout(form)
        self.host = qt.QLineEdit(DEFAULT_HOST)
        self.port = qt.QSpinBox()
        self.port.setRange(1, 65535)
        self.port.setValue(DEFAULT_PORT)
        self.button = qt.QPushButton("Connect")
        self.button.setCheckable(True)
        self.state = qt.QLabel("not connected")
        form.addRow("Host", self.host)
        form.addRow("Port", self.port)
        form.addRow(self.button)
        form.addRow("State", self.state)
        self.button.connect("toggled(bool)", self.on_toggled)
        self.layout.addStretch(1)

    def on_toggled(self, is_on):
        self.button.text = "Disconnect" if is_on else "Connect"
        if is_on:
            self.logic.connect_to(self.host.text.strip(), self.port.value)
        else:
            self.logic.disconnect()

    def show_state(self, text):
        self.state.text = text

    def cleanup(self):
        self.logic.disconnect()


class NertcaLiveLogic(ScriptedLoadableModuleLogic):
    """Connection to the program, and the display of the nodes that its messages become."""

    def __init__(self, show_state):
        super().__init__()
        self.show_state = show_state
        self.connector = None
        self.tags = []

    def connect_to(self, host, port):
        """Connects to a program, and shows what it sends. The connector tries again until the program is there."""
        self.disconnect()
        self.connector = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLIGTLConnectorNode", "nertca-vk")
        self.connector.SetTypeClient(host, port)
        self.observe(self.connector, self.connector.ConnectedEvent, lambda *_: self.show_state("connected"))
        self.observe(self.connector, self.connector.DisconnectedEvent, lambda *_: self.show_state("waiting for the program"))
        self.observe(slicer.mrmlScene, slicer.vtkMRMLScene.NodeAddedEvent, self.on_node_added)
        self.show_state("waiting for the program")
        self.connector.Start()
        # Nodes of an earlier connection are used again, so that none is added.
        for name in (OVERLAY, VESSELS):
            self.show(slicer.mrmlScene.GetFirstNodeByName(name))

    def disconnect(self):
        """Ends the connection; what was received stays."""
        for node, tag in self.tags:
            node.RemoveObserver(tag)
        self.tags = []
        if self.connector:
            self.connector.Stop()
            slicer.mrmlScene.RemoveNode(self.connector)
            self.connector = None
            self.show_state("not connected")

    def observe(self, node, event, call):
        self.tags.append((node, node.AddObserver(event, call)))

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def on_node_added(self, _scene, _event, node):
        # The node gets its data after it was added.
        qt.QTimer.singleShot(0, lambda: self.show(node))

    def show(self, node):
        """Shows a node that the program's messages update."""
        if node is None:
            return
        if node.IsA("vtkMRMLScalarVolumeNode") and node.GetName() == OVERLAY:
            self.show_overlay(node)
        elif node.IsA("vtkMRMLModelNode") and node.GetName() == VESSELS:
            self.show_vessels(node)

    def show_overlay(self, volume):
        """Shows the picture in the red slice, which follows its plane, and in 3D."""
        volume.CreateDefaultDisplayNodes()
        volume.GetDisplayNode().SetAutoWindowLevel(True)
        slicer.util.setSliceViewerLayers(background=volume, fit=True)
        red = slicer.app.layoutManager().sliceWidget("Red")
        red.mrmlSliceNode().RotateToVolumePlane(volume)
        red.sliceController().setSliceVisible(True)

    def show_vessels(self, model):
        """Shows the centrelines in colours of their radius."""
        model.CreateDefaultDisplayNodes()
        display = model.GetDisplayNode()
        display.SetLineWidth(4)
        display.SetActiveScalar(RADIUS, vtk.vtkAssignAttribute.POINT_DATA)
        display.SetAndObserveColorNodeID("vtkMRMLColorTableNodeFileViridis.txt")
        display.SetScalarRangeFlag(slicer.vtkMRMLDisplayNode.UseManualScalarRange)
        display.SetScalarRange(*RADII_MM)
        display.SetScalarVisibility(True)
