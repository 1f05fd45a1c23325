"""The paper: state X̂, errors, innovation, and the filters that set the gains."""
