//! Compiles `glsl/*.comp` (times the variants in `glsl/variants.txt`) to SPIR-V and writes a typed
//! kernel table, reflected from the SPIR-V itself, to `OUT_DIR/kernel_table.rs`. Binding names,
//! access (read / write) and push-constant sizes therefore have one source: the shader.

use rspirv::dr::{Instruction, Module, Operand};
use rspirv::spirv::{Decoration, Dim, Op, StorageClass};
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs};

type Failure = Box<dyn std::error::Error>;

/// The shared library carries its ABI version in its soname and is never unmapped: threads of its own, and of drivers it
/// loaded, may outlive a `dlclose`.
fn link_library() -> Result<(), Failure> {
    if env::var("CARGO_CFG_TARGET_OS")? != "linux" {
        return Ok(());
    }
    println!("cargo:rustc-cdylib-link-arg=-Wl,-z,nodelete");
    // cargo-c sets a soname of its own.
    if env::var_os("CARGO_FEATURE_CAPI").is_none() {
        let source = fs::read_to_string("src/capi/types.rs")?;
        let version = source.split("NERTCA_ABI_VERSION: u32 = ").nth(1).and_then(|rest| rest.split(';').next());
        let version = version.ok_or("src/capi/types.rs names no ABI version")?;
        println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libnertca_vk.so.{version}");
    }
    println!("cargo:rerun-if-changed=src/capi/types.rs");
    Ok(())
}

fn main() -> Result<(), Failure> {
    let glsl = PathBuf::from("glsl");
    println!("cargo:rerun-if-changed=glsl");
    println!("cargo:rerun-if-env-changed=SHADERC_LIB_DIR");
    println!("cargo:rustc-env=NERTCA_COMMIT={}", commit());
    link_library()?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let variants = read_variants(&glsl.join("variants.txt"))?;
    let compiler = shaderc::Compiler::new()?;
    let mut table = String::from("pub(crate) static KERNEL_TABLE: &[KernelCode] = &[\n");
    let mut sources: Vec<_> = fs::read_dir(&glsl)?
        .filter_map(|entry| entry.ok().map(|e| e.path()))
        .filter(|path| path.extension().is_some_and(|e| e == "comp"))
        .collect();
    sources.sort();
    for path in sources {
        let stem = path.file_stem().and_then(|s| s.to_str()).ok_or("shader name is not UTF-8")?.to_owned();
        let source = fs::read_to_string(&path)?;
        let mut builds = vec![(stem.clone(), Vec::new())];
        builds.extend(variants.get(&stem).cloned().unwrap_or_default());
        for (name, defines) in builds {
            let reflected = compile(&compiler, &glsl, &path, &source, &defines, false)?;
            let shipped = compile(&compiler, &glsl, &path, &source, &defines, true)?;
            let file = out.join(format!("{name}.spv"));
            fs::write(&file, shipped.as_binary_u8())?;
            table.push_str(&kernel_row(&name, &file, &reflect(reflected.as_binary())?));
        }
    }
    table.push_str("];\n");
    fs::write(out.join("kernel_table.rs"), table)?;
    Ok(())
}

/// Commit of the checkout, for benchmark reports; "unknown" outside one.
fn commit() -> String {
    // Written by every commit and checkout, not by edits: a build of edited sources names the commit they are based on.
    if Path::new(".git/logs/HEAD").exists() {
        println!("cargo:rerun-if-changed=.git/logs/HEAD");
    }
    let described = std::process::Command::new("git").args(["describe", "--always", "--dirty"]).output();
    match described {
        Ok(output) if output.status.success() => String::from_utf8_lossy(&output.stdout).trim().to_owned(),
        _ => "unknown".to_owned(),
    }
}

/// `variants.txt`: `shader name [DEFINE[=VALUE]]...` per line; `#` starts a comment.
fn read_variants(path: &Path) -> Result<BTreeMap<String, Vec<Variant>>, Failure> {
    let mut variants: BTreeMap<String, Vec<Variant>> = BTreeMap::new();
    for line in fs::read_to_string(path)?.lines() {
        let mut words = line.split('#').next().unwrap_or("").split_whitespace();
        let (Some(shader), Some(name)) = (words.next(), words.next()) else {
            continue;
        };
        let defines = words
            .map(|word| match word.split_once('=') {
                Some((key, value)) => (key.to_owned(), value.to_owned()),
                None => (word.to_owned(), "1".to_owned()),
            })
            .collect();
        variants.entry(shader.to_owned()).or_default().push((name.to_owned(), defines));
    }
    Ok(variants)
}

type Variant = (String, Vec<(String, String)>);

fn compile(
    compiler: &shaderc::Compiler,
    root: &Path,
    path: &Path,
    source: &str,
    defines: &[(String, String)],
    optimise: bool,
) -> Result<shaderc::CompilationArtifact, Failure> {
    let mut options = shaderc::CompileOptions::new()?;
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_2 as u32);
    options.set_warnings_as_errors();
    options.set_optimization_level(if optimise {
        shaderc::OptimizationLevel::Performance
    } else {
        shaderc::OptimizationLevel::Zero
    });
    for (key, value) in defines {
        options.add_macro_definition(key, Some(value));
    }
    let include_root = root.to_path_buf();
    options.set_include_callback(move |name, _, _, _| {
        let file = include_root.join(name);
        let content = fs::read_to_string(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        Ok(shaderc::ResolvedInclude { resolved_name: file.display().to_string(), content })
    });
    Ok(compiler.compile_into_spirv(
        source,
        shaderc::ShaderKind::Compute,
        &path.display().to_string(),
        "main",
        Some(&options),
    )?)
}

struct Binding {
    slot: u32,
    name: String,
    kind: &'static str,
    reads: bool,
    writes: bool,
}

struct Reflected {
    bindings: Vec<Binding>,
    push_bytes: u32,
    /// Buffers whose device address the shader wants as push constant `NAME_address`, with its offset.
    addresses: Vec<(String, u32)>,
    spec_constants: Vec<(String, u32)>,
}

fn id(operand: &Operand) -> Option<u32> {
    match operand {
        Operand::IdRef(id) => Some(*id),
        _ => None,
    }
}

fn literal(operand: Option<&Operand>) -> u32 {
    match operand {
        Some(Operand::LiteralBit32(value)) => *value,
        _ => 0,
    }
}

struct Names<'a> {
    names: HashMap<u32, &'a str>,
    members: HashMap<(u32, u32), &'a str>,
}

fn names(module: &Module) -> Names<'_> {
    let mut found = Names { names: HashMap::new(), members: HashMap::new() };
    for line in &module.debug_names {
        match (line.class.opcode, line.operands.as_slice()) {
            (Op::Name, [Operand::IdRef(id), Operand::LiteralString(name)]) => {
                found.names.insert(*id, name);
            }
            (Op::MemberName, [Operand::IdRef(id), Operand::LiteralBit32(i), Operand::LiteralString(name)]) => {
                found.members.insert((*id, *i), name);
            }
            _ => {}
        }
    }
    found
}

fn reflect(words: &[u32]) -> Result<Reflected, Failure> {
    let module = rspirv::dr::load_words(words).map_err(|e| format!("SPIR-V does not parse: {e}"))?;
    let names = names(&module);
    let types: HashMap<u32, &Instruction> =
        module.types_global_values.iter().filter_map(|i| i.result_id.map(|id| (id, i))).collect();
    let decorated = |target: u32, wanted: Decoration| {
        module.annotations.iter().find(|a| {
            a.class.opcode == Op::Decorate
                && a.operands.first().and_then(id) == Some(target)
                && a.operands.get(1) == Some(&Operand::Decoration(wanted))
        })
    };
    let member_decorated = |target: u32, member: u32, wanted: Decoration| {
        module.annotations.iter().find(|a| {
            a.class.opcode == Op::MemberDecorate
                && a.operands.first().and_then(id) == Some(target)
                && literal(a.operands.get(1)) == member
                && a.operands.get(2) == Some(&Operand::Decoration(wanted))
        })
    };
    let mut out = Reflected { bindings: Vec::new(), push_bytes: 0, addresses: Vec::new(), spec_constants: Vec::new() };
    for variable in module.types_global_values.iter().filter(|i| i.class.opcode == Op::Variable) {
        let (Some(variable_id), Some(pointer)) = (variable.result_id, variable.result_type) else {
            continue;
        };
        let pointee = types.get(&pointer).and_then(|p| p.operands.get(1)).and_then(id).unwrap_or(0);
        let Some(Operand::StorageClass(class)) = variable.operands.first() else {
            continue;
        };
        let slot = decorated(variable_id, Decoration::Binding).map(|a| literal(a.operands.get(2)));
        match (class, slot) {
            (StorageClass::PushConstant, _) => {
                let members = types.get(&pointee).map_or(0, |t| t.operands.len() as u32);
                for member in 0..members {
                    let offset =
                        member_decorated(pointee, member, Decoration::Offset).map_or(0, |a| literal(a.operands.get(3)));
                    let ty = types.get(&pointee).and_then(|t| t.operands.get(member as usize)).and_then(id);
                    let size = ty.and_then(|t| types.get(&t)).map_or(4, |t| match t.class.opcode {
                        Op::TypeVector => 4 * literal(t.operands.get(1)),
                        _ => 4,
                    });
                    match names.members.get(&(pointee, member)).and_then(|name| name.strip_suffix("_address")) {
                        Some(buffer) => out.addresses.push((buffer.to_owned(), offset)),
                        None => out.push_bytes = out.push_bytes.max(offset + size),
                    }
                }
            }
            (StorageClass::StorageBuffer, Some(slot)) => out.bindings.push(Binding {
                slot,
                name: names.members.get(&(pointee, 0)).ok_or("storage buffer without a member name")?.to_string(),
                kind: "Storage",
                reads: member_decorated(pointee, 0, Decoration::NonReadable).is_none(),
                writes: member_decorated(pointee, 0, Decoration::NonWritable).is_none(),
            }),
            (StorageClass::UniformConstant, Some(slot)) => {
                let image = types.get(&pointee).and_then(|t| t.operands.first()).and_then(id).unwrap_or(0);
                let dim = types.get(&image).and_then(|t| t.operands.get(1));
                let kind = match dim {
                    Some(Operand::Dim(Dim::DimBuffer)) => "Texel",
                    // A combined image and sampler: the image's type is one step further.
                    _ if types.get(&pointee).is_some_and(|t| t.class.opcode == Op::TypeSampledImage) => "Volume",
                    _ => return Err("only storage buffers, texel buffers and 3D samplers are supported".into()),
                };
                let name = names.names.get(&variable_id).ok_or("texel buffer or sampler without a name")?.to_string();
                out.bindings.push(Binding { slot, name, kind, reads: true, writes: false });
            }
            _ => {}
        }
    }
    out.bindings.sort_by_key(|b| b.slot);
    for annotation in &module.annotations {
        if annotation.operands.get(1) == Some(&Operand::Decoration(Decoration::SpecId)) {
            let target = annotation.operands.first().and_then(id).unwrap_or(0);
            let spec_id = literal(annotation.operands.get(2));
            // The workgroup size has no name of its own in SPIR-V; by convention it is constant 0.
            let name = match (spec_id, names.names.get(&target)) {
                (0, _) => "local_size_x".to_owned(),
                (_, Some(name)) => (*name).to_owned(),
                _ => return Err("specialisation constant without a name".into()),
            };
            out.spec_constants.push((name, spec_id));
        }
    }
    Ok(out)
}

fn kernel_row(name: &str, file: &Path, kernel: &Reflected) -> String {
    let mut row = String::new();
    let _ = writeln!(row, "    KernelCode {{ name: {name:?}, spirv: include_bytes!({:?}),", file.display().to_string());
    let _ =
        writeln!(row, "        push_bytes: {}, addresses: &{:?}, bindings: &[", kernel.push_bytes, kernel.addresses);
    for b in &kernel.bindings {
        let _ = writeln!(
            row,
            "            BindingCode {{ slot: {}, name: {:?}, kind: BindingKind::{}, reads: {}, writes: {} }},",
            b.slot, b.name, b.kind, b.reads, b.writes
        );
    }
    let _ = writeln!(row, "        ], spec_constants: &{:?} }},", kernel.spec_constants);
    row
}
