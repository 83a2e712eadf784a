//! Writes Rust from what the shaders declare.

use crate::Failure;
use crate::compile::Kernel;
use crate::reflect::{Field, Reflected, Structure, Type};
use crate::source::{Comments, Constant};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

/// Writes `static KERNEL_TABLE`: every kernel with its SPIR-V.
pub fn table(kernels: &[(Kernel, Reflected)], out: &Path) -> String {
    let mut text = String::from("pub(crate) static KERNEL_TABLE: &[KernelCode] = &[\n");
    for (kernel, reflected) in kernels {
        let file = out.join(format!("{}.spv", kernel.name));
        let _ = writeln!(
            text,
            "    KernelCode {{ name: {:?}, shader: {:?}, spirv: include_bytes!({:?}),\n        push_bytes: {}, addresses: &{:?}, \
             spec_constants: &{:?}, bindings: &[",
            kernel.name,
            kernel.shader,
            file.display().to_string(),
            reflected.push.used(),
            reflected.addresses,
            reflected.spec_constants
        );
        for b in &reflected.bindings {
            let _ = writeln!(
                text,
                "            BindingCode {{ slot: {}, name: {:?}, kind: BindingKind::{}, reads: {}, writes: {} }},",
                b.slot, b.name, b.kind, b.reads, b.writes
            );
        }
        text.push_str("        ] },\n");
    }
    text + "];\n"
}

/// Writes the structures that shaders and host share.
pub fn layout(kernels: &[(Kernel, Reflected)], comments: &Comments) -> Result<String, Failure> {
    let mut structures: BTreeMap<&str, &Structure> = BTreeMap::new();
    for (kernel, reflected) in kernels {
        for structure in &reflected.structures {
            let same = structures.entry(&structure.name).or_insert(structure);
            if *same != structure {
                return Err(format!("{}: another `{}` than in other shaders", kernel.name, structure.name).into());
            }
        }
    }
    let mut text = String::new();
    for (name, structure) in structures {
        let comment = |key: &str| comments.get(key).filter(|c| !c.is_empty());
        let about = comment(name).ok_or_else(|| format!("structure {name} has no comment above it"))?;
        let _ = write!(text, "/// {about}\n{}", head(name));
        fields(&mut text, structure, structure.size(), |field| {
            let about = comment(&format!("{name}.{}", field.name));
            about.cloned().ok_or_else(|| format!("field {name}.{} has no comment", field.name).into())
        })?;
        text.push_str(&offsets(name, structure));
    }
    Ok(text)
}

/// Writes the push constants of each shader.
pub fn push(kernels: &[(Kernel, Reflected)]) -> Result<String, Failure> {
    let mut text = String::new();
    let mut seen: BTreeMap<&str, &Reflected> = BTreeMap::new();
    for (kernel, reflected) in kernels {
        let names = |r: &Reflected| r.bindings.iter().map(|b| b.name.clone()).collect::<Vec<_>>();
        if let Some(first) = seen.get(kernel.shader.as_str()) {
            if first.push.fields != reflected.push.fields || names(first) != names(reflected) {
                return Err(format!("{}: other push constants or bindings than its shader's", kernel.name).into());
            }
            continue;
        }
        seen.insert(&kernel.shader, reflected);
        let name = camel_case(&kernel.shader);
        let allow = "#[allow(missing_docs, reason = \"the shader says what they mean\")]\n";
        let _ = write!(text, "/// Push constants of `{}`.\n{allow}{}", kernel.shader, head(&name));
        fields(&mut text, &reflected.push, reflected.push.used(), |_| Ok(String::new()))?;
        text.push_str(&offsets(&name, &reflected.push));
        let bindings: String = names(reflected).iter().map(|b| format!("Binding::{b}, ")).collect();
        let _ = writeln!(
            text,
            "impl PushConstants for {name} {{\n    const SHADER: &'static str = {:?};\n    \
             const BINDINGS: &'static [Binding] = &[{bindings}];\n    const LOCAL_SIZE: u32 = {};\n}}\n",
            kernel.shader, reflected.local_size
        );
    }
    Ok(text)
}

/// Writes `enum Binding`: the names of everything that shaders bind.
pub fn bindings(kernels: &[(Kernel, Reflected)]) -> String {
    let names: BTreeSet<&str> = kernels.iter().flat_map(|(_, r)| &r.bindings).map(|b| b.name.as_str()).collect();
    let mut text = String::from(
        "/// Buffers that shaders bind, by the names in the shaders.\n#[derive(Debug, Clone, Copy, PartialEq, Eq)]\n\
         #[allow(non_camel_case_types, missing_docs, reason = \"names and meanings are the shaders'\")]\n\
         pub enum Binding {\n",
    );
    for name in &names {
        let _ = writeln!(text, "    {name},");
    }
    text.push_str("}\n\nimpl Binding {\n    /// The name in the shaders.\n    pub fn name(self) -> &'static str {\n");
    text.push_str("        match self {\n");
    for name in &names {
        let _ = writeln!(text, "            Binding::{name} => {name:?},");
    }
    text + "        }\n    }\n}\n"
}

/// Writes the integer constants of one include.
pub fn constants(constants: &[Constant]) -> String {
    let constant = |c: &Constant| {
        let comment = if c.comment.is_empty() { "see the shaders" } else { &c.comment };
        format!("#[doc = {:?}]\npub const {}: u32 = {};\n", sentence(comment), c.name, c.value)
    };
    constants.iter().map(constant).collect()
}

/// Writes the numbers that the text of a kernel fixes, in one module for each kernel that has some.
pub fn numbers(numbers: &BTreeMap<String, BTreeMap<String, u32>>) -> String {
    let mut text = String::new();
    for (kernel, numbers) in numbers {
        let _ = writeln!(text, "/// Constants of `{kernel}`.\npub mod {kernel} {{");
        for (name, value) in numbers {
            let _ = writeln!(text, "    /// `{name}` of the shader.\n    pub const {name}: u32 = {value};");
        }
        text.push_str("}\n\n");
    }
    text
}

fn head(name: &str) -> String {
    format!(
        "#[repr(C)]\n#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]\n\
         pub struct {name} {{\n"
    )
}

/// Writes the fields up to `size` bytes, with gaps filled by padding.
fn fields(
    text: &mut String,
    structure: &Structure,
    size: u32,
    about: impl Fn(&Field) -> Result<String, Failure>,
) -> Result<(), Failure> {
    let mut at = 0;
    let padding = |text: &mut String, from: u32, to: u32| {
        if to > from {
            let _ = writeln!(text, "    #[doc(hidden)]\n    pub padding_at_{from}: [u32; {}],", (to - from) / 4);
        }
    };
    for field in &structure.fields {
        padding(text, at, field.offset);
        let about = about(field)?;
        if !about.is_empty() {
            let _ = writeln!(text, "    #[doc = {:?}]", sentence(&about));
        }
        let _ = writeln!(text, "    pub {}: {},", field.name, rust_type(&field.ty));
        at = field.offset + field.ty.size();
    }
    padding(text, at, size);
    text.push_str("}\n");
    Ok(())
}

/// Writes compile-time checks that Rust puts each field at the offset it has in the shaders.
fn offsets(name: &str, structure: &Structure) -> String {
    let check =
        |f: &Field| format!("const _: () = assert!(std::mem::offset_of!({name}, {}) == {});\n", f.name, f.offset);
    structure.fields.iter().map(check).collect::<String>() + "\n"
}

fn rust_type(ty: &Type) -> String {
    match ty {
        Type::Vector { component, count: 1 } => (*component).to_owned(),
        Type::Vector { component, count } => format!("[{component}; {count}]"),
        Type::Structure(structure) => structure.name.clone(),
    }
}

/// Turns a comment into a doc sentence: it begins with a capital and ends with a full stop.
fn sentence(comment: &str) -> String {
    let mut letters = comment.chars();
    let first = letters.next().map(|c| c.to_uppercase().to_string()).unwrap_or_default();
    format!(" {first}{}.", letters.as_str().trim_end_matches('.'))
}

fn camel_case(name: &str) -> String {
    let word = |word: &str| {
        let (first, rest) = word.split_at(1);
        first.to_uppercase() + rest
    };
    name.split('_').map(word).collect()
}
