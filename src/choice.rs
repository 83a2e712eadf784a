//! Choices that users make by name: on a command line, in a query or in a file.

/// An enumeration whose values have names.
pub trait Choice: Copy + Send + Sync + 'static {
    /// All values.
    const ALL: &'static [Self];

    /// Name that a user writes for the value.
    fn name(self) -> &'static str;

    /// Returns the value with a name.
    fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|choice| choice.name() == name)
    }

    /// All names, separated by commas, for messages.
    fn names() -> String {
        Self::ALL.iter().map(|choice| choice.name()).collect::<Vec<_>>().join(", ")
    }
}
