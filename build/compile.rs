//! Compiles `glsl/*/*.comp`, a folder for each method and for what methods share, with every variant listed in `glsl/variants.txt`, to SPIR-V.

use crate::Failure;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Name and value of a definition, as in `-DNAME=VALUE`.
pub type Define = (String, String);

/// A shader, or one of its variants.
pub struct Kernel {
    /// Name of the shader's file.
    pub shader: String,
    /// Name of the variant; the shader's own name for the build without a variant.
    pub name: String,
    /// Definitions that set the variant apart.
    pub defines: Vec<Define>,
    /// The shader's text.
    pub source: String,
    /// SPIR-V without optimisation, with all names.
    pub for_reflection: Vec<u32>,
    /// Optimised SPIR-V, as bytes; empty for a kernel on cooperative matrices if the compiler does not know them.
    pub shipped: Vec<u8>,
}

/// Include of the shaders that need cooperative matrices.
const MATRICES: &str = "inc/matrices.glsl";
/// Definition with which such a shader declares its buffers and constants only.
const DECLARATIONS_ONLY: &str = "DECLARATIONS_ONLY";

/// Environment variable that treats the compiler as one that does not know cooperative matrices, for tests.
pub const WITHOUT_MATRICES: &str = "NERTCA_WITHOUT_MATRICES";

/// Tells whether the compiler knows cooperative matrices; those of older systems do not.
fn knows_matrices(compiler: &shaderc::Compiler) -> Result<bool, Failure> {
    if std::env::var_os(WITHOUT_MATRICES).is_some() {
        return Ok(false);
    }
    let source = "#version 450\n#extension GL_KHR_cooperative_matrix : require\nvoid main() {}";
    let mut options = shaderc::CompileOptions::new()?;
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_2 as u32);
    let probe = compiler.compile_into_spirv(source, shaderc::ShaderKind::Compute, "probe", "main", Some(&options));
    Ok(probe.is_ok())
}

/// Lists the files and folders in a folder.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    Ok(fs::read_dir(folder)?.filter_map(|entry| entry.ok().map(|e| e.path())).collect())
}

/// Compiles every shader and every variant; shaders in the order of their names.
pub fn kernels(glsl: &Path) -> Result<Vec<Kernel>, Failure> {
    let variants = read_variants(&glsl.join("variants.txt"))?;
    let compiler = shaderc::Compiler::new()?;
    let knows_matrices = knows_matrices(&compiler)?;
    let mut sources = Vec::new();
    for folder in entries(glsl)?.into_iter().filter(|path| path.is_dir()) {
        sources.extend(entries(&folder)?.into_iter().filter(|path| path.extension().is_some_and(|e| e == "comp")));
    }
    // Tables of stages are in the order of names, whatever the folders.
    sources.sort_by_key(|path| path.file_name().map(ToOwned::to_owned));
    let mut kernels = Vec::new();
    for path in sources {
        let shader = path.file_stem().and_then(|s| s.to_str()).ok_or("shader name is not UTF-8")?.to_owned();
        let source = fs::read_to_string(&path)?;
        let mut builds = vec![(shader.clone(), Vec::new())];
        builds.extend(variants.get(&shader).cloned().unwrap_or_default());
        let declarations_only = !knows_matrices && source.contains(MATRICES);
        for (name, mut defines) in builds {
            if declarations_only {
                defines.push((DECLARATIONS_ONLY.to_owned(), "1".to_owned()));
            }
            let build = |optimise| compile(&compiler, glsl, &path, &source, &defines, optimise);
            let for_reflection = build(false)?.as_binary().to_vec();
            let shipped = if declarations_only { Vec::new() } else { build(true)?.as_binary_u8().to_vec() };
            let (shader, source) = (shader.clone(), source.clone());
            kernels.push(Kernel { shader, name, defines, source, for_reflection, shipped });
        }
    }
    Ok(kernels)
}

/// Name of a variant of a shader, and its definitions.
type Variant = (String, Vec<Define>);

/// Reads `variants.txt`: one `shader name [DEFINE[=VALUE]]...` per line; `#` starts a comment.
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

fn compile(
    compiler: &shaderc::Compiler,
    root: &Path,
    path: &Path,
    source: &str,
    defines: &[Define],
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
