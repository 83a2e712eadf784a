//! Reads geometries of the Reconstruction Toolkit (RTK): `RTKThreeDCircularGeometry` in XML.

use crate::error::{Error, Result};
use crate::files;
use roxmltree::{Document, Node, ParsingOptions};
use std::path::Path;

/// Largest accepted size of a file, bytes.
const MAX_FILE_BYTES: u64 = 64 << 20;
/// Largest accepted number of XML nodes: a projection has about thirty.
const MAX_NODES: u32 = 1 << 20;
/// Largest accepted depth of elements.
const MAX_DEPTH: usize = 16;
const ROOT: &str = "RTKThreeDCircularGeometry";

/// Projection from homogeneous RTK coordinates, mm, to homogeneous detector coordinates, mm.
pub type RtkMatrix = [[f64; 4]; 3];

/// Reads the projection matrices of a geometry.
///
/// # Errors
/// [`Error::Data`] naming file and element; [`Error::Io`].
pub fn read_geometry(path: &Path) -> Result<Vec<RtkMatrix>> {
    let text = files::read_text(path, MAX_FILE_BYTES)?;
    check_depth(&text).map_err(|problem| Error::data(path, "file", problem))?;
    let options = ParsingOptions { allow_dtd: true, nodes_limit: MAX_NODES };
    let document =
        Document::parse_with_options(&text, options).map_err(|e| Error::data(path, "file", e.to_string()))?;
    let root = document.root_element();
    if !root.has_tag_name(ROOT) {
        return Err(Error::data(
            path,
            root.tag_name().name(),
            format!("is not the element {ROOT} of a geometry of RTK"),
        ));
    }
    let mut matrices = Vec::new();
    for projection in root.children().filter(|node| node.has_tag_name("Projection")) {
        let field = |name: &str| format!("projection {}: {name}", matrices.len() + 1);
        let bad = |name: &str, problem: String| Err(Error::data(path, field(name), problem));
        let radius =
            text_of(root, "RadiusCylindricalDetector").or_else(|| text_of(projection, "RadiusCylindricalDetector"));
        if radius.is_some_and(|radius| radius.trim().parse() != Ok(0.0)) {
            return bad("RadiusCylindricalDetector", "is not 0: a flat detector is needed".into());
        }
        let Some(text) = text_of(projection, "Matrix") else { return bad("Matrix", "is missing".into()) };
        let numbers: std::result::Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
        match numbers.as_deref() {
            Ok(numbers) if numbers.len() == 12 && numbers.iter().all(|number| number.is_finite()) => {
                matrices.push(std::array::from_fn(|row| std::array::from_fn(|column| numbers[4 * row + column])));
            }
            _ => return bad("Matrix", "does not consist of twelve finite numbers".into()),
        }
    }
    if matrices.is_empty() {
        return Err(Error::data(path, "Projection", "there is none"));
    }
    Ok(matrices)
}

/// Text of a child element.
fn text_of<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.children().find(|child| child.has_tag_name(name))?.text()
}

/// Checks that elements are not nested deeply, because the parser recurses once per level. Entities, which may hold elements, are refused.
fn check_depth(text: &str) -> std::result::Result<(), String> {
    let (mut depth, mut rest) = (0usize, text);
    while let Some(at) = rest.find('<') {
        rest = &rest[at..];
        let skipped = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")];
        let end = if let Some((_, end)) = skipped.iter().find(|(begin, _)| rest.starts_with(begin)) {
            rest.find(end)
        } else if rest.starts_with("<!") {
            let end = rest.find('>');
            if end.is_some_and(|end| rest[..end].contains('[')) {
                return Err("has a document type with entities".into());
            }
            end
        } else if rest.starts_with("</") {
            depth = depth.saturating_sub(1);
            rest.find('>')
        } else {
            let end = end_of_tag(rest);
            depth += usize::from(!end.is_some_and(|end| rest[..end].ends_with('/')));
            end
        };
        if depth > MAX_DEPTH {
            return Err(format!("has elements nested deeper than {MAX_DEPTH} levels"));
        }
        // The parser refuses what has no end.
        let Some(end) = end else { break };
        rest = &rest[end..];
    }
    Ok(())
}

/// Returns the place of the `>` that ends a tag; attributes may contain others.
fn end_of_tag(tag: &str) -> Option<usize> {
    let mut quote = None;
    tag.char_indices().find_map(|(at, c)| match (quote, c) {
        (None, '>') => Some(at),
        (None, '"' | '\'') => {
            quote = Some(c);
            None
        }
        (Some(open), _) if open == c => {
            quote = None;
            None
        }
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Vec<RtkMatrix>> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("geometry.xml");
        std::fs::write(&path, text).unwrap();
        read_geometry(&path)
    }

    #[test]
    fn faults_are_named() {
        let good = "<Projection><Matrix>1 2 3 4 5 6 7 8 9 10 11 12</Matrix></Projection>";
        let of = |inside: &str| {
            format!("<?xml version=\"1.0\"?><!DOCTYPE RTKGEOMETRY><{ROOT} version=\"3\">{inside}</{ROOT}>")
        };
        assert_eq!(read(&of(good)).unwrap(), [[[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [9.0, 10.0, 11.0, 12.0]]]);
        let cylinder = "<RadiusCylindricalDetector>500</RadiusCylindricalDetector>";
        for (text, part) in [
            (of(""), "there is none"),
            (of("<Projection/>"), "projection 1: Matrix"),
            (of(&good.replace("12", "")), "twelve"),
            (of(&good.replace("12", "nan")), "twelve"),
            (of(&format!("{good}{}", good.replace("12", "x"))), "projection 2: Matrix"),
            (of(&format!("{cylinder}{good}")), "flat detector"),
            (format!("<svg>{good}</svg>"), ROOT),
            ("<a".into(), "file"),
            ("<a>".repeat(1 << 16), "nested"),
            ("<a b='>'><!--</a>-->".repeat(1 << 16), "nested"),
            (of(good).replace("RTKGEOMETRY", "RTKGEOMETRY [<!ENTITY a '<b/>'>]"), "entities"),
        ] {
            let message = read(&text).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("geometry.xml"), "{message}");
        }
    }
}
