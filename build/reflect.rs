//! Reads the bindings, push constants and shared structures of a shader from its SPIR-V.

use crate::Failure;
use rspirv::dr::{Instruction, Module, Operand};
use rspirv::spirv::{Decoration, Dim, Op, StorageClass};
use std::collections::HashMap;

/// A buffer, texel buffer or sampler.
pub struct Binding {
    pub slot: u32,
    pub name: String,
    /// Variant of `BindingKind`.
    pub kind: &'static str,
    pub reads: bool,
    pub writes: bool,
}

/// Type of a field that the host shares.
#[derive(Debug, Clone, PartialEq)]
pub enum Type {
    /// Scalar or vector; `component` is a Rust type of four bytes.
    Vector { component: &'static str, count: u32 },
    /// Structure, with its own fields.
    Structure(Structure),
}

/// A field with its offset in bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    pub name: String,
    pub offset: u32,
    pub ty: Type,
}

/// A structure in a buffer, or the push constants.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    pub name: String,
    pub fields: Vec<Field>,
}

impl Type {
    pub fn size(&self) -> u32 {
        match self {
            Type::Vector { count, .. } => 4 * count,
            Type::Structure(structure) => structure.size(),
        }
    }

    /// Alignment by the rules of std430.
    fn alignment(&self) -> u32 {
        match self {
            Type::Vector { count, .. } => 4 * count.next_power_of_two(),
            Type::Structure(structure) => structure.alignment(),
        }
    }
}

impl Structure {
    fn alignment(&self) -> u32 {
        self.fields.iter().map(|f| f.ty.alignment()).max().unwrap_or(4)
    }

    /// Number of bytes up to the end of the last field.
    pub fn used(&self) -> u32 {
        self.fields.iter().map(|f| f.offset + f.ty.size()).max().unwrap_or(0)
    }

    /// Number of bytes from one element of an array to the next.
    pub fn size(&self) -> u32 {
        self.used().next_multiple_of(self.alignment())
    }
}

/// Declarations of one shader.
pub struct Reflected {
    pub bindings: Vec<Binding>,
    /// Push constants without addresses.
    pub push: Structure,
    /// Buffers whose device address the shader takes as push constant `NAME_address`, with its offset.
    pub addresses: Vec<(String, u32)>,
    /// Name and id of each specialisation constant.
    pub spec_constants: Vec<(String, u32)>,
    /// Default number of invocations of a workgroup.
    pub local_size: u32,
    /// Structures in the shader's buffers.
    pub structures: Vec<Structure>,
}

/// Reads unoptimised SPIR-V.
pub fn reflect(words: &[u32]) -> Result<Reflected, Failure> {
    let module = rspirv::dr::load_words(words).map_err(|e| format!("SPIR-V does not parse: {e}"))?;
    let spirv = Spirv::new(&module);
    let (push, addresses) = spirv.push_constants()?;
    let (spec_constants, local_size) = spirv.spec_constants()?;
    let (bindings, structures) = (spirv.bindings()?, spirv.structures()?);
    Ok(Reflected { bindings, push, addresses, spec_constants, local_size, structures })
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

/// SPIR-V module with lookup tables of its names and types.
struct Spirv<'a> {
    module: &'a Module,
    names: HashMap<u32, &'a str>,
    members: HashMap<(u32, u32), &'a str>,
    types: HashMap<u32, &'a Instruction>,
}

impl<'a> Spirv<'a> {
    fn new(module: &'a Module) -> Spirv<'a> {
        let (mut names, mut members) = (HashMap::new(), HashMap::new());
        for line in &module.debug_names {
            match (line.class.opcode, line.operands.as_slice()) {
                (Op::Name, [Operand::IdRef(id), Operand::LiteralString(name)]) => {
                    names.insert(*id, name.as_str());
                }
                (Op::MemberName, [Operand::IdRef(id), Operand::LiteralBit32(i), Operand::LiteralString(name)]) => {
                    members.insert((*id, *i), name.as_str());
                }
                _ => {}
            }
        }
        let types = module.types_global_values.iter().filter_map(|i| i.result_id.map(|id| (id, i))).collect();
        Spirv { module, names, members, types }
    }

    fn decoration(&self, target: u32, wanted: Decoration) -> Option<&Instruction> {
        self.module.annotations.iter().find(|a| {
            a.class.opcode == Op::Decorate
                && a.operands.first().and_then(id) == Some(target)
                && a.operands.get(1) == Some(&Operand::Decoration(wanted))
        })
    }

    fn member_decoration(&self, target: u32, member: u32, wanted: Decoration) -> Option<&Instruction> {
        self.module.annotations.iter().find(|a| {
            a.class.opcode == Op::MemberDecorate
                && a.operands.first().and_then(id) == Some(target)
                && literal(a.operands.get(1)) == member
                && a.operands.get(2) == Some(&Operand::Decoration(wanted))
        })
    }

    /// Returns operand `index` of a type, if that operand is an id.
    fn operand(&self, of: u32, index: usize) -> Option<u32> {
        self.types.get(&of).and_then(|t| t.operands.get(index)).and_then(id)
    }

    /// Lists the global variables: id, storage class, and the type pointed to.
    fn variables(&self) -> impl Iterator<Item = (u32, StorageClass, u32)> {
        self.module.types_global_values.iter().filter(|i| i.class.opcode == Op::Variable).filter_map(|variable| {
            let Some(Operand::StorageClass(class)) = variable.operands.first() else { return None };
            Some((variable.result_id?, *class, self.operand(variable.result_type?, 1)?))
        })
    }

    fn bindings(&self) -> Result<Vec<Binding>, Failure> {
        let mut bindings = Vec::new();
        for (variable, class, pointee) in self.variables() {
            let Some(slot) = self.decoration(variable, Decoration::Binding).map(|a| literal(a.operands.get(2))) else {
                continue;
            };
            match class {
                StorageClass::StorageBuffer => bindings.push(Binding {
                    slot,
                    name: self.members.get(&(pointee, 0)).ok_or("storage buffer without a member name")?.to_string(),
                    kind: "Storage",
                    reads: self.member_decoration(pointee, 0, Decoration::NonReadable).is_none(),
                    writes: self.member_decoration(pointee, 0, Decoration::NonWritable).is_none(),
                }),
                StorageClass::Uniform => bindings.push(Binding {
                    slot,
                    name: self.members.get(&(pointee, 0)).ok_or("uniform buffer without a member name")?.to_string(),
                    kind: "Uniform",
                    reads: true,
                    writes: false,
                }),
                StorageClass::UniformConstant => bindings.push(Binding {
                    slot,
                    name: self.names.get(&variable).ok_or("texel buffer or sampler without a name")?.to_string(),
                    kind: self.sampler_kind(pointee)?,
                    reads: true,
                    writes: false,
                }),
                _ => {}
            }
        }
        bindings.sort_by_key(|b| b.slot);
        Ok(bindings)
    }

    fn sampler_kind(&self, sampler: u32) -> Result<&'static str, Failure> {
        let image = self.operand(sampler, 0).unwrap_or(0);
        match self.types.get(&image).and_then(|t| t.operands.get(1)) {
            Some(Operand::Dim(Dim::DimBuffer)) => Ok("Texel"),
            // A combined image and sampler: the image's type is one step further.
            _ if self.types.get(&sampler).is_some_and(|t| t.class.opcode == Op::TypeSampledImage) => Ok("Volume"),
            _ => Err("only buffers, texel buffers and 3D samplers are supported".into()),
        }
    }

    /// Returns the push constants, and separately the addresses among them.
    fn push_constants(&self) -> Result<(Structure, Vec<(String, u32)>), Failure> {
        let block = self.variables().find(|(_, class, _)| *class == StorageClass::PushConstant);
        let Some((_, _, block)) = block else {
            return Ok((Structure { name: String::new(), fields: Vec::new() }, Vec::new()));
        };
        let mut push = self.structure(block)?;
        let addresses =
            push.fields.iter().filter_map(|f| Some((f.name.strip_suffix("_address")?.to_owned(), f.offset)));
        let addresses = addresses.collect();
        push.fields.retain(|f| !f.name.ends_with("_address"));
        Ok((push, addresses))
    }

    /// Returns the named structures that have a layout and are not a block themselves.
    fn structures(&self) -> Result<Vec<Structure>, Failure> {
        let mut structures = Vec::new();
        for structure in self.module.types_global_values.iter().filter(|i| i.class.opcode == Op::TypeStruct) {
            let Some(id) = structure.result_id else { continue };
            // A structure that the shader also keeps in registers has a second type, without offsets.
            let laid_out = self.member_decoration(id, 0, Decoration::Offset).is_some();
            if laid_out && self.decoration(id, Decoration::Block).is_none() {
                structures.push(self.structure(id)?);
                self.check_stride(id, structures.last())?;
            }
        }
        Ok(structures)
    }

    /// Checks that the size computed here is the stride that the compiler gave an array of the structure.
    fn check_stride(&self, element: u32, structure: Option<&Structure>) -> Result<(), Failure> {
        let arrays = self.types.iter().filter(|(array, instruction)| {
            instruction.class.opcode == Op::TypeRuntimeArray && self.operand(**array, 0) == Some(element)
        });
        for (array, _) in arrays {
            let stride = self.decoration(*array, Decoration::ArrayStride).map(|a| literal(a.operands.get(2)));
            if let (Some(stride), Some(structure)) = (stride, structure)
                && stride != structure.size()
            {
                return Err(format!("{}: {} bytes, in arrays {stride}", structure.name, structure.size()).into());
            }
        }
        Ok(())
    }

    fn structure(&self, id: u32) -> Result<Structure, Failure> {
        let members = self.types.get(&id).map_or(0, |t| t.operands.len() as u32);
        let name = self.names.get(&id).copied().unwrap_or_default().to_owned();
        let field = |member: u32| -> Result<Field, Failure> {
            let field = self.members.get(&(id, member)).ok_or("structure with a nameless field")?.to_string();
            let offset = self.member_decoration(id, member, Decoration::Offset).ok_or("field without an offset")?;
            let ty = self.operand(id, member as usize).ok_or("field without a type")?;
            let ty = self.ty(ty).map_err(|e| format!("{name}.{field}: {e}"))?;
            Ok(Field { name: field, offset: literal(offset.operands.get(3)), ty })
        };
        Ok(Structure { fields: (0..members).map(field).collect::<Result<_, _>>()?, name })
    }

    fn ty(&self, ty: u32) -> Result<Type, Failure> {
        let instruction = self.types.get(&ty).ok_or("unknown type")?;
        let component = |ty: &Instruction| match (ty.class.opcode, literal(ty.operands.first())) {
            (Op::TypeFloat, 32) => Ok("f32"),
            (Op::TypeInt, 32) if literal(ty.operands.get(1)) == 0 => Ok("u32"),
            (Op::TypeInt, 32) => Ok("i32"),
            _ => Err("only 32-bit numbers, vectors and structures of them are shared with the host"),
        };
        match instruction.class.opcode {
            Op::TypeStruct => Ok(Type::Structure(self.structure(ty)?)),
            Op::TypeVector => {
                let of = self.operand(ty, 0).and_then(|of| self.types.get(&of)).ok_or("vector of an unknown type")?;
                Ok(Type::Vector { component: component(of)?, count: literal(instruction.operands.get(1)) })
            }
            _ => Ok(Type::Vector { component: component(instruction)?, count: 1 }),
        }
    }

    /// Returns names and ids of the specialisation constants, and the default size of a workgroup.
    fn spec_constants(&self) -> Result<(Vec<(String, u32)>, u32), Failure> {
        let (mut constants, mut local_size) = (Vec::new(), 1);
        for annotation in &self.module.annotations {
            if annotation.operands.get(1) == Some(&Operand::Decoration(Decoration::SpecId)) {
                let target = annotation.operands.first().and_then(id).unwrap_or(0);
                let spec_id = literal(annotation.operands.get(2));
                // The workgroup size has no name of its own in SPIR-V; by convention it is constant 0.
                let name = match (spec_id, self.names.get(&target)) {
                    (0, _) => {
                        local_size = self.types.get(&target).map_or(1, |t| literal(t.operands.first()));
                        "local_size_x".to_owned()
                    }
                    (_, Some(name)) => (*name).to_owned(),
                    _ => return Err("specialisation constant without a name".into()),
                };
                constants.push((name, spec_id));
            }
        }
        Ok((constants, local_size))
    }
}
