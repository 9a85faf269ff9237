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
            /// The range of a key, in words.
            pub(crate) fn bounds(key: &str) -> Option<String> {
                $($(if key == stringify!($key) {
                    let (low, high): ($type, $type) = ($low, $high);
                    return Some(format!("{low} to {high}"));
                })?)*
                None
            }

            /// The first key whose value is another one there.
            #[allow(dead_code, reason = "not every section belongs to one of several algorithms")]
            pub fn changed(&self, other: &Self) -> Option<&'static str> {
                $(if self.$key != other.$key {
                    return Some(stringify!($key));
                })*
                None
            }

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
