//! Measurements of a tree as a DICOM structured report (TID 1500 of PS3.16): lengths, diameters, stenoses, centrelines and their doubt.

use crate::error::Result;
use crate::export::dicom::{ANATOMY, CORONARY, Code, LABEL};
use crate::export::structured::{self, ContentItem, PrivateScheme, Relationship, ReportSeeds, Value};
use crate::trees::lesions::{Lesion, lesions};
use crate::trees::tree::{BeatTree, Branch, Doubt, PhaseTree, RadiiFrom};
use std::path::Path;

/// Rounding of numbers, per unit: a tenth of a micrometre.
const PER_UNIT: f64 = 1e4;

const fn dcm(value: &'static str, meaning: &'static str) -> Code {
    Code { value, scheme: "DCM", meaning }
}

const fn sct(value: &'static str, meaning: &'static str) -> Code {
    Code { value, scheme: "SCT", meaning }
}

const fn unit(value: &'static str, meaning: &'static str) -> Code {
    Code { value, scheme: "UCUM", meaning }
}

const fn own(value: &'static str, meaning: &'static str) -> Code {
    Code { value, scheme: OWN.designator, meaning }
}

/// Scheme of the codes that no standard has.
const OWN: PrivateScheme =
    PrivateScheme { designator: "99NERTCA", name: "Codes of nertca-vk", organization: "nertca-vk" };

const REPORT: Code = dcm("126000", "Imaging Measurement Report");
const LANGUAGE: Code = dcm("121049", "Language of Content Item and Descendants");
const ENGLISH: Code = Code { value: "en", scheme: "RFC5646", meaning: "English" };
const OBSERVER_TYPE: Code = dcm("121005", "Observer Type");
const DEVICE: Code = dcm("121007", "Device");
const DEVICE_UID: Code = dcm("121012", "Device Observer UID");
const DEVICE_NAME: Code = dcm("121013", "Device Observer Name");
const DEVICE_MANUFACTURER: Code = dcm("121014", "Device Observer Manufacturer");
const PROCEDURE: Code = dcm("121058", "Procedure reported");
const CORONARY_ARTERIOGRAPHY: Code = sct("33367005", "Coronary Arteriography");
const MEASUREMENTS: Code = dcm("126010", "Imaging Measurements");
const GROUP: Code = dcm("125007", "Measurement Group");
const TRACKING_NAME: Code = dcm("112039", "Tracking Identifier");
const TRACKING_UID: Code = dcm("112040", "Tracking Unique Identifier");
const CATEGORY: Code = sct("276214006", "Finding category");
const ABNORMAL: Code = sct("49755003", "Morphologically Abnormal Structure");
const FINDING: Code = dcm("121071", "Finding");
const STENOSIS: Code = sct("415582006", "Stenosis");
const SITE: Code = sct("363698007", "Finding Site");
const ALGORITHM_NAME: Code = dcm("111001", "Algorithm Name");
const ALGORITHM_VERSION: Code = dcm("111003", "Algorithm Version");
const ALGORITHM_PARAMETERS: Code = dcm("111002", "Algorithm Parameters");
const TIME_POINT: Code = Code { value: "C2348792", scheme: "UMLS", meaning: "Time Point" };
const TIME_POINT_ORDER: Code = dcm("126073", "Time Point Order");
const LENGTH: Code = sct("410668003", "Length");
const LUMEN_DIAMETER: Code = sct("397413000", "Vessel lumen diameter");
const DIAMETER_STENOSIS: Code = sct("408715008", "Degree of blood vessel lumen diameter reduction");
const DERIVATION: Code = dcm("121401", "Derivation");
const MEAN: Code = sct("373098007", "Mean");
const MINIMUM: Code = sct("255605001", "Minimum");
const METHOD: Code = sct("370129005", "Measurement Method");
const CURVE_FITTED: Code = dcm("122489", "Curve Fitted Reference");
const SOURCE: Code = dcm("121112", "Source of Measurement");
const FROM_ROOT: Code = own("FROMROOT", "Length along the vessels from the root of the tree");
const GAP: Code = own("GAP", "Length of gaps in which the field shows no vessel");
const DOUBT: Code = own("DOUBT", "Half width of the 68 % interval across the vessel");
const DOUBT_WITH_MOTION: Code = own("DOUBTMOTION", "Half width of the 68 % interval with motion along the vessel");
const EXISTENCE: Code = own("EXISTENCE", "Probability that a vessel exists within 3 mm");

const MM: Code = unit("mm", "millimeter");
const PERCENT: Code = unit("%", "percent");
const NO_UNIT: Code = unit("1", "no units");

/// Writes the measurements of a tree. Vessels and branches are reported at every phase of the tree; stenoses at every phase, or at the first
/// phase where points are followed, because followed points keep their radii.
///
/// # Errors
/// [`crate::error::Error::Io`].
pub fn write(beat: &BeatTree, path: &Path, seeds: &ReportSeeds) -> Result<()> {
    structured::write(path, &report(beat, seeds), &OWN, seeds)
}

/// Returns the root of the report.
fn report(beat: &BeatTree, seeds: &ReportSeeds) -> ContentItem {
    let groups = beat.phases.iter().enumerate().flat_map(|(index, tree)| {
        let groups = PhaseGroups { beat, tree, tracking: seeds.tracking };
        let has_stenoses = index == 0 || beat.reference_phase.is_none();
        let stenoses = if has_stenoses { groups.stenoses() } else { Vec::new() };
        [groups.vessels()].into_iter().chain(groups.branches()).chain(stenoses).collect::<Vec<_>>()
    });
    let measurements = contains(MEASUREMENTS, Value::Container(None)).with(groups);
    let mut children = vec![modifier(LANGUAGE, Value::Code(ENGLISH))];
    children.extend([
        context(OBSERVER_TYPE, Value::Code(DEVICE)),
        context(DEVICE_UID, Value::Uid(seeds.tracking)),
        context(DEVICE_NAME, Value::Text("nertca-vk".into())),
        context(DEVICE_MANUFACTURER, Value::Text("nertca-vk".into())),
    ]);
    children.extend([modifier(PROCEDURE, Value::Code(CORONARY_ARTERIOGRAPHY)), measurements]);
    contains(REPORT, Value::Container(Some("1500"))).with(children)
}

fn contains(name: Code, value: Value) -> ContentItem {
    ContentItem::new(Relationship::Contains, name, value)
}

fn context(name: Code, value: Value) -> ContentItem {
    ContentItem::new(Relationship::HasObsContext, name, value)
}

fn modifier(name: Code, value: Value) -> ContentItem {
    ContentItem::new(Relationship::HasConceptMod, name, value)
}

fn number(name: Code, value: f64, unit: Code) -> ContentItem {
    contains(name, Value::Number((PER_UNIT * value).round() / PER_UNIT, unit))
}

/// Subject of a group of measurements.
struct Subject {
    /// Name for people.
    name: String,
    /// Number that distinguishes the subject from all others of the report.
    key: u128,
    category: Code,
    finding: Code,
}

/// Groups of measurements at one phase.
struct PhaseGroups<'a> {
    beat: &'a BeatTree,
    tree: &'a PhaseTree,
    /// Random number from which the UIDs of subjects are made.
    tracking: u128,
}

/// Kinds of subjects, and the distances of their keys: more than there are phases, branches or stenoses.
const VESSELS: u128 = 1;
const BRANCH: u128 = 2;
const STENOSES: u128 = 3;
const OF_KIND: u128 = 1 << 64;
const OF_PHASE: u128 = 1 << 32;

impl PhaseGroups<'_> {
    /// Returns the key of a subject: the same at all phases where points are followed, and different ones otherwise.
    fn key(&self, kind: u128, index: usize) -> u128 {
        let phase = if self.beat.reference_phase.is_some() { 0 } else { u128::from(self.tree.phase) };
        kind * OF_KIND + phase * OF_PHASE + index as u128
    }

    fn group(&self, subject: Subject, measurements: Vec<ContentItem>) -> ContentItem {
        let phase = self.tree.phase;
        let parameters = format!(
            "{LABEL}. Vessel above {:.4e} per mm; resolution of the field {:.2} mm; diameters from the {}",
            self.beat.threshold_per_mm,
            self.beat.resolution_mm,
            match self.beat.radii_from {
                RadiiFrom::Images => "images",
                RadiiFrom::Field => "field",
            }
        );
        let order = Value::Number(f64::from(phase), NO_UNIT);
        let about = [
            context(TRACKING_NAME, Value::Text(subject.name)),
            context(TRACKING_UID, Value::Uid(self.tracking.wrapping_add(subject.key))),
            contains(CATEGORY, Value::Code(subject.category)),
            contains(FINDING, Value::Code(subject.finding)),
            contains(SITE, Value::Code(CORONARY)),
            modifier(ALGORITHM_NAME, Value::Text("nertca-vk".into())),
            modifier(ALGORITHM_VERSION, Value::Text(env!("CARGO_PKG_VERSION").into())),
            modifier(ALGORITHM_PARAMETERS, Value::Text(parameters)),
            context(TIME_POINT, Value::Text(format!("cardiac phase {phase}"))),
            context(TIME_POINT_ORDER, order),
        ];
        contains(GROUP, Value::Container(Some("1501"))).with(about.into_iter().chain(measurements))
    }

    /// Returns the group of all vessels.
    fn vessels(&self) -> ContentItem {
        let subject =
            Subject { name: "vessels".into(), key: self.key(VESSELS, 0), category: ANATOMY, finding: CORONARY };
        self.group(subject, vec![number(LENGTH, self.tree.length_mm(), MM)])
    }

    /// Returns a group for each branch.
    fn branches(&self) -> Vec<ContentItem> {
        self.tree.branches.iter().enumerate().map(|(index, branch)| self.branch(index, branch)).collect()
    }

    fn branch(&self, index: usize, branch: &Branch) -> ContentItem {
        let leaves = branch.parent.map_or_else(String::new, |parent| format!(", which leaves branch {parent}"));
        let subject = Subject {
            name: format!("branch {index}{leaves}"),
            key: self.key(BRANCH, index),
            category: ANATOMY,
            finding: CORONARY,
        };
        let line = ContentItem::new(Relationship::InferredFrom, SOURCE, Value::Points(branch.points_mm.clone()));
        let derived = |how: Code, diameter_mm: f64| {
            number(LUMEN_DIAMETER, diameter_mm, MM).with([modifier(DERIVATION, Value::Code(how))])
        };
        let mut measurements = vec![
            number(LENGTH, branch.length_mm(), MM).with([line]),
            derived(MEAN, branch.mean_diameter_mm()),
            derived(MINIMUM, branch.min_diameter_mm()),
        ];
        measurements.extend((branch.gap_mm > 0.0).then(|| number(GAP, branch.gap_mm, MM)));
        measurements.extend(branch.median_doubt_mm().map(|mm| number(DOUBT, mm, MM)));
        measurements.extend(branch.existence().map(|share| number(EXISTENCE, share, NO_UNIT)));
        self.group(subject, measurements)
    }

    /// Returns a group for each stenosis.
    fn stenoses(&self) -> Vec<ContentItem> {
        let found = lesions(self.tree, self.beat.measurement());
        found.iter().enumerate().map(|(index, lesion)| self.stenosis(index, lesion)).collect()
    }

    fn stenosis(&self, index: usize, lesion: &Lesion) -> ContentItem {
        let branch = &self.tree.branches[lesion.branch];
        let subject = Subject {
            name: format!("stenosis {index}, in branch {}", lesion.branch),
            key: self.key(STENOSES, index),
            category: ABNORMAL,
            finding: STENOSIS,
        };
        let place = Value::Points(vec![branch.points_mm[lesion.point]]);
        let mut measurements = vec![
            number(LUMEN_DIAMETER, lesion.min_diameter_mm, MM).with([
                modifier(DERIVATION, Value::Code(MINIMUM)),
                ContentItem::new(Relationship::InferredFrom, SOURCE, place),
            ]),
            number(LUMEN_DIAMETER, lesion.reference_diameter_mm, MM)
                .with([modifier(METHOD, Value::Code(CURVE_FITTED))]),
            number(DIAMETER_STENOSIS, lesion.percent(), PERCENT),
            number(LENGTH, lesion.length_mm, MM),
            number(FROM_ROOT, lesion.from_root_mm, MM),
        ];
        measurements.extend(branch.doubt.get(lesion.point).into_iter().flat_map(doubt));
        self.group(subject, measurements)
    }
}

/// Returns the doubt about a point.
fn doubt(doubt: &Doubt) -> Vec<ContentItem> {
    let with_motion = doubt.with_motion_mm.map(|mm| number(DOUBT_WITH_MOTION, mm, MM));
    let mut items = vec![number(DOUBT, doubt.across_mm, MM)];
    items.extend(with_motion);
    items.push(number(EXISTENCE, doubt.existence, NO_UNIT));
    items
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn beat(reference_phase: Option<u32>) -> BeatTree {
        let doubt = Doubt { across_mm: 0.4, direction: DVec3::X, with_motion_mm: Some(0.7), existence: 0.9 };
        // A vessel of 3 mm with a narrowing to 1.2 mm.
        let radius_mm: Vec<f64> = (0..81).map(|i| 1.5 - 0.9 * (-((f64::from(i) - 40.0) / 4.0).powi(2)).exp()).collect();
        let branch = Branch {
            parent: None,
            points_mm: (0..81).map(|i| DVec3::Z * f64::from(i)).collect(),
            doubt: vec![doubt; radius_mm.len()],
            radius_mm,
            agreement: Vec::new(),
            gap_mm: 0.0,
        };
        let phases = [0, 5].map(|phase| PhaseTree { phase, branches: vec![branch.clone()] }).to_vec();
        BeatTree {
            reference_phase,
            threshold_per_mm: 0.02,
            resolution_mm: 1.0,
            spacing_mm: 0.5,
            views: Vec::new(),
            phases,
            vessel_per_mm: None,
            radii_from: RadiiFrom::Field,
            measured_mm: Vec::new(),
        }
    }

    fn groups(beat: &BeatTree) -> Vec<ContentItem> {
        let seeds = ReportSeeds { study: 1, series: 2, frame: 3, instance: 4, tracking: 5 };
        let report = report(beat, &seeds);
        let measurements = report.children.into_iter().find(|item| item.name == MEASUREMENTS).unwrap();
        measurements.children
    }

    fn value_of(group: &ContentItem, name: Code) -> &Value {
        &group.children.iter().find(|item| item.name == name).unwrap().value
    }

    #[test]
    fn followed_vessels_keep_their_identifiers() {
        let names = |beat: &BeatTree| -> Vec<(Value, Value)> {
            let of =
                |group: &ContentItem| (value_of(group, TRACKING_NAME).clone(), value_of(group, TRACKING_UID).clone());
            groups(beat).iter().map(of).collect()
        };
        let followed = names(&beat(Some(0)));
        assert_eq!(followed.len(), 5, "vessels and branch twice, the stenosis once");
        assert_eq!((&followed[0], &followed[1]), (&followed[3], &followed[4]));
        let single = names(&beat(None));
        assert_eq!(single.len(), 6);
        for a in 0..single.len() {
            (0..a).for_each(|b| assert_ne!(single[a].1, single[b].1, "{a} and {b}"));
        }
    }

    #[test]
    fn gaps_and_the_source_of_diameters_are_reported() {
        let Value::Text(parameters) = value_of(&groups(&beat(Some(0)))[1], ALGORITHM_PARAMETERS).clone() else {
            panic!("a text")
        };
        assert!(parameters.ends_with("diameters from the field"), "{parameters}");
        let mut other = beat(Some(0));
        assert!(groups(&other)[1].children.iter().all(|item| item.name != GAP), "a branch without gaps");
        other.radii_from = RadiiFrom::Images;
        other.phases[0].branches[0].gap_mm = 4.5;
        let branch = &groups(&other)[1];
        assert_eq!(value_of(branch, GAP), &Value::Number(4.5, MM));
        let Value::Text(parameters) = value_of(branch, ALGORITHM_PARAMETERS) else { panic!("a text") };
        assert!(parameters.ends_with("diameters from the images"), "{parameters}");
    }

    #[test]
    fn a_stenosis_has_its_numbers_and_its_place() {
        let all = groups(&beat(Some(0)));
        let stenosis = &all[2];
        assert_eq!(value_of(stenosis, FINDING), &Value::Code(STENOSIS));
        let Value::Number(percent, unit) = value_of(stenosis, DIAMETER_STENOSIS) else { panic!("a number") };
        assert!((55.0..70.0).contains(percent) && *unit == PERCENT, "{percent}");
        assert_eq!(value_of(stenosis, FROM_ROOT), &Value::Number(40.0, MM));
        assert_eq!(value_of(stenosis, DOUBT), &Value::Number(0.4, MM));
        assert_eq!(value_of(stenosis, EXISTENCE), &Value::Number(0.9, NO_UNIT));
        let least = stenosis.children.iter().find(|item| item.name == LUMEN_DIAMETER).unwrap();
        assert_eq!(least.children[1].value, Value::Points(vec![DVec3::Z * 40.0]));
    }
}
