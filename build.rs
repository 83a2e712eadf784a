//! Compiles the shaders of `glsl/` to SPIR-V and writes Rust from what their text and their SPIR-V declare: the kernel table,
//! the structures and numbers shared with the host, the push constants and the names of all bindings. The shader is therefore
//! the single source of all of these.

#[path = "build/compile.rs"]
mod compile;
#[path = "build/generate.rs"]
mod generate;
#[path = "build/reflect.rs"]
mod reflect;
#[path = "build/source.rs"]
mod source;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{env, fs};

type Failure = Box<dyn std::error::Error>;

/// End of the names of includes whose structures and integer constants the host uses as well.
const SHARED: &str = "layout.glsl";
/// Other includes whose integer constants the host uses as well.
const SHARED_CONSTANTS: [&str; 3] = ["occupancy.glsl", "positions.glsl", "sample_rays.glsl"];
/// Include whose integer constants stand in a file of their own.
const RANDOM: &str = "random.glsl";

fn main() -> Result<(), Failure> {
    println!("cargo:rerun-if-changed=build");
    println!("cargo:rerun-if-changed=glsl");
    println!("cargo:rerun-if-env-changed=SHADERC_LIB_DIR");
    println!("cargo:rerun-if-env-changed={}", compile::WITHOUT_MATRICES);
    if let Some(directory) = env::var_os("SHADERC_LIB_DIR") {
        println!("cargo:rerun-if-changed={}", Path::new(&directory).join("libshaderc_combined.a").display());
    }
    let out = PathBuf::from(env::var("OUT_DIR")?);
    write_shaders(Path::new("glsl"), &out)
}

fn write_shaders(glsl: &Path, out: &Path) -> Result<(), Failure> {
    let mut kernels = Vec::new();
    let mut numbers = BTreeMap::new();
    for kernel in compile::kernels(glsl)? {
        let about = |e: Failure| format!("{}: {e}", kernel.name);
        let reflected = reflect::reflect(&kernel.for_reflection).map_err(about)?;
        let fixed = source::numbers(&kernel.source, &kernel.defines).map_err(about)?;
        if !fixed.is_empty() {
            numbers.insert(kernel.name.clone(), fixed);
        }
        fs::write(out.join(format!("{}.spv", kernel.name)), &kernel.shipped)?;
        kernels.push((kernel, reflected));
    }
    fs::write(out.join("table.rs"), generate::table(&kernels, out))?;
    let (mut comments, mut constants) = (source::Comments::new(), Vec::new());
    let mut includes = compile::entries(&glsl.join("inc"))?;
    includes.sort();
    for path in includes {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let text = fs::read_to_string(&path)?;
        if name.ends_with(SHARED) {
            comments.extend(source::comments(&text));
        }
        if name.ends_with(SHARED) || SHARED_CONSTANTS.contains(&name) {
            constants.extend(source::constants(&text));
        }
        if name == RANDOM {
            fs::write(out.join("random.rs"), generate::constants(&source::constants(&text)))?;
        }
    }
    fs::write(out.join("constants.rs"), generate::constants(&constants))?;
    fs::write(out.join("layout.rs"), generate::layout(&kernels, &comments)?)?;
    fs::write(out.join("push.rs"), generate::push(&kernels)?)?;
    fs::write(out.join("bindings.rs"), generate::bindings(&kernels))?;
    fs::write(out.join("numbers.rs"), generate::numbers(&numbers))?;
    Ok(())
}
