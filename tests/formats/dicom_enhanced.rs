//! Enhanced XA objects, whose geometry, times, shutters and heart beat stand in functional groups.

use crate::pydicom::Files;
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk_import::dicom::Relationship;

/// Writes an Enhanced XA object: what differs between frames stands in their own groups, everything else in the shared one.
const OBJECT: &str = "
from pydicom.dataset import Dataset
def group(**values):
    d = Dataset()
    for name, value in values.items():
        setattr(d, name, value)
    return d
def enhanced(turning=False, changes=lambda d: None):
    d = read()
    pixels = d.pixel_array
    d.SOPClassUID = d.file_meta.MediaStorageSOPClassUID = '1.2.840.10008.5.1.4.1.1.12.1.1'
    for name in ('FrameTime', 'PositionerPrimaryAngle', 'PositionerSecondaryAngle', 'DistanceSourceToDetector',
                 'DistanceSourceToPatient', 'ImagerPixelSpacing', 'PixelIntensityRelationship'):
        delattr(d, name)
    angles = lambda k: group(PositionerPositionSequence=[group(PositionerPrimaryAngle=30 + 5 * k, PositionerSecondaryAngle=-20 - k)])
    shared = group(
        XRayGeometrySequence=[group(DistanceSourceToIsocenter=700.0, DistanceSourceToDetector=1000.0)],
        FramePixelDataPropertiesSequence=[group(FrameType=['ORIGINAL', 'PRIMARY', 'SINGLE PLANE', 'SINGLE A'],
                                                ImagerPixelSpacing=[2.0, 1.5], PixelIntensityRelationship='LIN')],
        FrameDisplayShutterSequence=[group(ShutterShape='RECTANGULAR', ShutterLeftVerticalEdge=3, ShutterRightVerticalEdge=61,
                                           ShutterUpperHorizontalEdge=1, ShutterLowerHorizontalEdge=64)],
    )
    if not turning:
        shared.update(angles(0))
    d.SharedFunctionalGroupsSequence = [shared]
    frames = []
    for k in range(6):
        own = group(FrameContentSequence=[group(FrameReferenceDateTime=f'202611262359{59.5 + 0.1 * k:09.6f}' if k < 5
                                                else '20261127000000.000000')])
        own.TablePositionSequence = [group(TableTopVerticalPosition=100.0 + k, TableTopLongitudinalPosition=-50.0,
                                           TableTopLateralPosition=2.0 * k)]
        own.CardiacSynchronizationSequence = [group(NominalCardiacTriggerDelayTime=100.0 * (k % 4 + 1))]
        if turning:
            own.update(angles(k))
        frames.append(own)
    d.PerFrameFunctionalGroupsSequence = frames
    changes(d)
    return d, pixels
";

fn files(script: &str) -> Files {
    Files::by(&format!("{OBJECT}{script}"))
}

#[test]
fn geometry_times_and_shutters_come_from_functional_groups() {
    let files = files("save('still', *enhanced())\nsave('turning', *enhanced(turning=True))");
    for name in ["still", "turning"] {
        let run = files.read(name);
        for (k, c_arm) in run.c_arms.iter().enumerate() {
            let turned = if name == "turning" { k as f64 } else { 0.0 };
            assert_eq!((c_arm.primary_deg, c_arm.secondary_deg), (30.0 + 5.0 * turned, -20.0 - turned), "{name}");
            assert_eq!((c_arm.sid_mm, c_arm.sod_mm, c_arm.pixel_mm), (1000.0, 700.0, [1.5, 2.0]), "{name}");
            assert_eq!(c_arm.table_mm, [2.0 * k as f64, 100.0 + k as f64, -50.0], "{name}");
            // The last frame was taken at midnight.
            assert!((run.times_s[k] - 0.1 * k as f64).abs() < 1e-6, "{name}: {:?}", run.times_s);
        }
        assert_eq!(run.relationship, Relationship::Linear, "{name}");
        // Edges are counted from 1 and belong to the shutter.
        assert_eq!(run.open, (3..60, 1..63), "{name}");
        // Frames 0 and 4 were taken 100 ms after an R-peak.
        let phase = |time_s| run.r_peaks.as_ref().unwrap().beat_time(time_s, 4, BeatScaling::Linear).unwrap().phase;
        assert_eq!([-0.05, 0.05, 0.15, 0.25].map(phase), [0, 1, 2, 3], "{name}");
        assert!(run.notes.join("\n").contains("NominalCardiacTriggerDelayTime"), "{:?}", run.notes);
    }
}

#[test]
fn a_modality_lut_of_functional_groups_is_applied() {
    let files = files(
        "
def rescale(d):
    d.SharedFunctionalGroupsSequence[0].PixelValueTransformationSequence = [group(RescaleSlope=2, RescaleIntercept=-7, RescaleType='US')]
d, pixels = enhanced(changes=rescale)
save('shared', d, 2.0 * pixels - 7)
def differing(d):
    rescale(d)
    d.PerFrameFunctionalGroupsSequence[3].PixelValueTransformationSequence = [group(RescaleSlope=3, RescaleIntercept=0, RescaleType='US')]
save('differing', *enhanced(changes=differing))
",
    );
    assert_eq!(files.read("shared").range.white, 503.0);
    assert!(files.refusal("differing").contains("RescaleSlope: differs between frames"));
}

#[test]
fn what_functional_groups_lack_is_named_with_its_frame() {
    let files = files(
        "
def without(*path):
    def change(d):
        d = d.SharedFunctionalGroupsSequence[0]
        for name in path[:-1]:
            d = d[name][0]
        delattr(d, path[-1])
    return change
save('sid', *enhanced(changes=without('XRayGeometrySequence', 'DistanceSourceToDetector')))
save('sod', *enhanced(changes=without('XRayGeometrySequence')))
save('pitch', *enhanced(changes=without('FramePixelDataPropertiesSequence')))
save('angle', *enhanced(changes=without('PositionerPositionSequence')))
def isocentre(d):
    without('PositionerPositionSequence')(d)
    d.SharedFunctionalGroupsSequence[0].IsocenterReferenceSystemSequence = [
        group(PositionerIsocenterPrimaryAngle=12.0, PositionerIsocenterSecondaryAngle=3.0)]
save('isocentre', *enhanced(changes=isocentre))
def few(d):
    del d.PerFrameFunctionalGroupsSequence[5]
save('few', *enhanced(changes=few))
# Times that do not rise, but a frame time beside them.
def frozen(d):
    for frame in d.PerFrameFunctionalGroupsSequence:
        frame.FrameContentSequence[0].FrameReferenceDateTime = '20261126120000'
    d.FrameTime = 250
save('frozen', *enhanced(changes=frozen))
def volume(d):
    d.SOPClassUID = d.file_meta.MediaStorageSOPClassUID = '1.2.840.10008.5.1.4.1.1.13.1.1'
save('volume', *enhanced(changes=volume))
",
    );
    for (name, told) in [
        ("sid", "(0018,1110) DistanceSourceToDetector: is missing in the functional groups of frame 1"),
        ("sod", "(0018,1110) DistanceSourceToDetector: is missing in the functional groups of frame 1"),
        ("pitch", "ImagerPixelSpacing: is missing"),
        ("angle", "PositionerPrimaryAngle: is missing in the functional groups of frame 1"),
        ("few", "PerFrameFunctionalGroupsSequence: has 5 items for 6 frames"),
        ("volume", "X-Ray 3D Angiographic Image, which holds a reconstructed volume"),
    ] {
        let refusal = files.refusal(name);
        assert!(refusal.contains(told), "{name}: {refusal}");
    }
    let run = files.read("isocentre");
    assert_eq!((run.c_arms[5].primary_deg, run.c_arms[5].secondary_deg), (12.0, 3.0));
    assert!(run.notes.join("\n").contains("PositionerIsocenterPrimaryAngle is used"));
    assert_eq!(files.read("frozen").times_s[5], 1.25);
}
