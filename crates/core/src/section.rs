//! Sections of a configuration as tables of their keys.

/// Defines a section: every key with its default and, after a comma, the range that it is checked against.
macro_rules! section {
    ($(#[$meta:meta])* $name:ident {
        $($(#[$doc:meta])* $key:ident: $type:ty = $default:expr $(, $low:literal..=$high:expr)?;)*
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name {
            $($(#[$doc])* pub $key: $type,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($key: $default,)* }
            }
        }

        impl $name {
            /// `Ok` if every value is in its range; `section` is the section's dotted name.
            pub(crate) fn check_ranges(&self, section: &str) -> Result<(), $crate::error::FieldError> {
                let key = |name| $crate::toml_table::dotted(section, name);
                $($($crate::error::check_range(key(stringify!($key)), self.$key, $low, $high)?;)?)*
                Ok(())
            }
        }
    };
}

pub(crate) use section;
