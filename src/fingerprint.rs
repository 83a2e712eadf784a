//! Fingerprints tell versions of a thing apart: FNV-1a with 64 bits. They are no protection against forgery.

use std::io::Write;

const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
const PRIME: u64 = 0x0100_0000_01b3;

/// A fingerprint in the making, of all that was taken in so far; also something to write to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fingerprint(u64);

impl Default for Fingerprint {
    fn default() -> Self {
        Fingerprint(OFFSET)
    }
}

impl Fingerprint {
    /// The fingerprint of bytes alone.
    pub fn of(bytes: &[u8]) -> Fingerprint {
        let mut fingerprint = Fingerprint::default();
        fingerprint.bytes(bytes);
        fingerprint
    }

    /// Takes bytes in.
    pub fn bytes(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.word(u32::from(*byte)));
    }

    /// Takes a word in as a whole, which is faster than its bytes and gives another fingerprint.
    pub fn word(&mut self, word: u32) {
        self.0 = (self.0 ^ u64::from(word)).wrapping_mul(PRIME);
    }

    /// As a number.
    pub fn value(self) -> u64 {
        self.0
    }

    /// As 16 hexadecimal digits.
    pub fn hex(self) -> String {
        format!("{:016x}", self.0)
    }
}

impl Write for Fingerprint {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.bytes(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_fnv_1a() {
        // Of the published test vectors (Fowler, Noll, Vo).
        assert_eq!(Fingerprint::default().hex(), "cbf29ce484222325");
        assert_eq!(Fingerprint::of(b"foobar").value(), 0x8594_4171_f739_67e8);
    }
}
