//! Golden values of an independent script: float64 tensors with a description of the case.
#![allow(dead_code, reason = "each test file uses its part")]

use safetensors::SafeTensors;
use serde_json::Value;

/// A file of `tests/golden`.
pub struct Golden {
    bytes: Vec<u8>,
    /// Settings of the script.
    pub case: Value,
}

impl Golden {
    /// Reads `name`, a file made by `script`.
    pub fn open(name: &str, script: &str) -> Golden {
        let path = crate::root::root().join(format!("tests/golden/{name}.safetensors"));
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}; run {script}", path.display()));
        let (_, metadata) = SafeTensors::read_metadata(&bytes).unwrap();
        let case = serde_json::from_str(&metadata.metadata().as_ref().unwrap()["case"]).unwrap();
        Golden { bytes, case }
    }

    /// Tells whether there is a tensor of this name.
    pub fn has(&self, name: &str) -> bool {
        SafeTensors::deserialize(&self.bytes).unwrap().tensor(name).is_ok()
    }

    /// The values of a tensor.
    pub fn get(&self, name: &str) -> Vec<f64> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let data = tensors.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}")).data().to_vec();
        data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect()
    }
}
